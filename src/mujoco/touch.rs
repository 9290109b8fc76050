//! Which geoms may touch at all, by the masks, exclusions and parents of a model.

use super::Model;

/// `mjDSBL_FILTERPARENT`: bodies touch their parents too.
const PARENTS_TOO: i32 = 1 << 9;

impl Model {
    /// Whether two geoms may touch where they meet, without a pair that says so.
    pub fn may_touch(&self, a: usize, b: usize) -> bool {
        let (own, other) = (self.geom_contype(), self.geom_conaffinity());
        if own[a] & other[b] == 0 && own[b] & other[a] == 0 {
            return false;
        }
        let bodies = [a, b].map(|g| self.geom_bodyid()[g]);
        let (least, most) = (bodies[0].min(bodies[1]), bodies[0].max(bodies[1]));
        if (self.exclude_signature()).contains(&(((least + 1) << 16) + most + 1)) {
            return false;
        }
        let [one, two] = [a, b].map(|g| self.weld(g));
        let parent = |body: usize| self.body_weldid()[self.body_parentid()[body] as usize] as usize;
        let kin = one != 0 && two != 0 && (parent(one) == two || parent(two) == one);
        one != two && (!kin || self.option().disable_flags & PARENTS_TOO != 0)
    }

    /// Whether there are geoms that may touch, wherever they are. If not, the engine's search for contacts finds none.
    pub fn has_contacts(&self) -> bool {
        let n = self.ngeom();
        let any = || (0..n).any(|a| (0..a).any(|b| self.may_touch(a, b)));
        !self.pair_geom1().is_empty() || any()
    }

    /// The body that a geom's is welded to, 0 for the world.
    pub fn weld(&self, geom: usize) -> usize {
        self.body_weldid()[self.geom_bodyid()[geom] as usize] as usize
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn contacts_are_where_masks_parents_and_exclusions_leave_some() {
        let chain = |geom: &str, more: &str| {
            let xml = format!(
                r#"<mujoco><worldbody><body name="a"><joint/><geom size=".1" {geom}/><body name="b"><joint/><geom size=".1" {geom}/>
                <body name="c"><joint/><geom name="c" size=".1" {geom}/></body></body></body></worldbody>{more}</mujoco>"#
            );
            Model::from_xml_str(&xml).expect("a model").has_contacts()
        };
        // the first and the last of three
        assert!(chain("", ""));
        assert!(!chain(r#"contype="0" conaffinity="0""#, ""));
        assert!(!chain(r#"contype="2" conaffinity="1""#, ""));
        let excluded = r#"<contact><exclude body1="a" body2="c"/></contact>"#;
        assert!(!chain("", excluded));
        // without a parent's privilege the others touch
        let parents = format!(r#"{excluded}<option><flag filterparent="disable"/></option>"#);
        assert!(chain("", &parents));
        let pair = r#"<contact><pair geom1="t" geom2="c"/></contact><worldbody><geom name="t" size="1 1 1" type="plane"
            contype="0" conaffinity="0"/></worldbody>"#;
        assert!(chain(r#"contype="0" conaffinity="0""#, pair));
    }
}
