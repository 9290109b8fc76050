//! Which kinematic trees an element of a model acts upon.
//!
//! A tree is everything that hangs together by joints below a fixed body. Its inertia is its own: trees feel each other
//! through tendons, equalities, actuators and contacts only. A fixed body acts on those that it touches or that something
//! ties to it.

use std::collections::BTreeSet;

use crate::mjcf::attribute::Target;
use crate::mujoco::Model;

/// Pairs of geoms that touch at some knot.
pub(crate) type Contacts = BTreeSet<[usize; 2]>;
/// Indices of trees.
pub(super) type Trees = BTreeSet<usize>;

/// The trees of a model, and what acts on them.
pub(super) struct Reach<'a> {
    model: &'a Model,
    contacts: &'a Contacts,
    n: usize,
    of_body: Vec<Option<usize>>,  // none: fixed
    bearing: Vec<(usize, usize)>, // a fixed body and a tree that something ties to it
}

impl<'a> Reach<'a> {
    pub(super) fn new(model: &'a Model, contacts: &'a Contacts) -> Self {
        let mut of_body: Vec<Option<usize>> = vec![None; model.nbody()];
        let mut n = 0;
        for b in 1..model.nbody() {
            of_body[b] = of_body[model.body_parentid()[b] as usize];
            if of_body[b].is_none() && model.body_dofnum()[b] > 0 {
                of_body[b] = Some(n);
                n += 1;
            }
        }
        let mut out = Self {
            model,
            contacts,
            n,
            of_body,
            bearing: Vec::new(),
        };
        let sensors = (0..model.nsensor()).map(|s| out.sensor_bodies(s));
        let tied: Vec<Vec<usize>> = out.ties().chain(sensors.flatten()).collect();
        for bodies in tied {
            for &fixed in bodies.iter().filter(|b| out.of_body[**b].is_none()) {
                let trees = bodies.iter().filter_map(|b| out.of_body[*b]);
                out.bearing.extend(trees.map(|t| (fixed, t)));
            }
        }
        out
    }

    /// Number of trees.
    pub(super) fn len(&self) -> usize {
        self.n
    }

    fn all(&self) -> Trees {
        (0..self.n).collect()
    }

    /// The tree of a degree of freedom.
    pub(super) fn of_dof(&self, dof: usize) -> usize {
        // every body with a joint is in a tree
        self.of_body[self.model.dof_bodyid()[dof] as usize].unwrap_or(0)
    }

    /// Sets of trees that feel each other.
    pub(super) fn tied(&self) -> Vec<Trees> {
        if self.model.extension().is_some_and(|e| !e.is_local()) {
            return vec![self.all()]; // it may act on anything
        }
        let model = self.model;
        let mut out: Vec<Trees> = self.ties().map(|bodies| self.trees(&bodies)).collect();
        out.extend((0..model.ntendon()).map(|t| self.element("tendon", t)));
        out.extend((0..model.nu()).map(|a| self.element("actuator", a)));
        out.extend((0..model.neq()).map(|e| self.element("equality", e)));
        out
    }

    /// Trees that a parameter of the model acts upon.
    pub(super) fn target(&self, target: &Target) -> Trees {
        let model = self.model;
        match target.attribute.kind {
            "body" => self.changed(target.id),
            "geom" => self.changed(model.geom_bodyid()[target.id] as usize),
            "site" => self.changed(model.site_bodyid()[target.id] as usize),
            "pair" => {
                let geoms = [
                    model.pair_geom1()[target.id] as usize,
                    model.pair_geom2()[target.id] as usize,
                ];
                let touch = |c: &[usize; 2]| *c == geoms || *c == [geoms[1], geoms[0]];
                if self.contacts.iter().any(touch) {
                    self.trees(&self.bodies_of_geoms(geoms))
                } else {
                    Trees::new()
                }
            }
            kind => self.element(kind, target.id),
        }
    }

    /// Trees on which a sensor depends.
    pub(super) fn sensor(&self, sensor: usize) -> Trees {
        const RANGEFINDER: i32 = 7; // mjSENS_RANGEFINDER: sees whatever is in its way
        if self.model.sensor_type()[sensor] == RANGEFINDER {
            return self.all();
        }
        let Some(bodies) = self.sensor_bodies(sensor) else {
            return self.all();
        };
        let mut out = self.trees(&bodies);
        // a fixed body bears, and its centre of mass counts, all that it carries
        let own = bodies[0];
        if self.of_body[own].is_none() {
            out.append(&mut self.below(own));
        }
        if out.is_empty() { self.all() } else { out }
    }

    /// Trees of actuator `id`.
    pub(super) fn actuator(&self, id: usize) -> Trees {
        self.element("actuator", id)
    }

    /// Trees of the joint, tendon, actuator or equality; all where it might be any.
    fn element(&self, kind: &str, id: usize) -> Trees {
        let bodies = match kind {
            "joint" => Some(vec![self.model.jnt_bodyid()[id] as usize]),
            "tendon" => Some(self.tendon(id)),
            "actuator" => self.transmission(id),
            "equality" => self.equality(id),
            _ => None,
        };
        bodies.map_or_else(|| self.all(), |b| self.trees(&b))
    }

    fn trees(&self, bodies: &[usize]) -> Trees {
        bodies.iter().filter_map(|b| self.of_body[*b]).collect()
    }

    /// Trees that feel a change of body `b`.
    pub(super) fn changed(&self, b: usize) -> Trees {
        let mut out = self.below(b);
        let borne = (self.bearing.iter()).filter(|(fixed, _)| self.is_below(*fixed, b));
        out.extend(borne.map(|(_, tree)| *tree));
        out
    }

    /// Trees of body `b` and what it carries.
    fn below(&self, b: usize) -> Trees {
        (0..self.model.nbody())
            .filter(|i| self.is_below(*i, b))
            .filter_map(|i| self.of_body[i])
            .collect()
    }

    fn is_below(&self, mut body: usize, root: usize) -> bool {
        while body > root {
            body = self.model.body_parentid()[body] as usize;
        }
        body == root
    }

    fn bodies_of_geoms(&self, geoms: [usize; 2]) -> Vec<usize> {
        geoms.map(|g| self.model.geom_bodyid()[g] as usize).to_vec()
    }

    /// Bodies that something ties together: contacts, tendons, equalities, transmissions.
    fn ties(&self) -> impl Iterator<Item = Vec<usize>> {
        let model = self.model;
        (self.contacts.iter().map(|c| self.bodies_of_geoms(*c)))
            .chain((0..model.ntendon()).map(|t| self.tendon(t)))
            .chain((0..model.neq()).filter_map(|e| self.equality(e)))
            .chain((0..model.nu()).filter_map(|a| self.transmission(a)))
    }

    fn tendon(&self, tendon: usize) -> Vec<usize> {
        let model = self.model;
        let first = model.tendon_adr()[tendon] as usize;
        let path = first..first + model.tendon_num()[tendon] as usize;
        path.filter_map(|w| {
            let id = usize::try_from(model.wrap_objid()[w]).ok()?;
            let body = match model.wrap_type()[w] {
                1 => model.jnt_bodyid()[id],      // mjWRAP_JOINT
                3 => model.site_bodyid()[id],     // mjWRAP_SITE
                4 | 5 => model.geom_bodyid()[id], // mjWRAP_SPHERE, mjWRAP_CYLINDER
                _ => return None,
            };
            Some(body as usize)
        })
        .collect()
    }

    /// Bodies of an actuator's transmission; none: any.
    fn transmission(&self, actuator: usize) -> Option<Vec<usize>> {
        let model = self.model;
        let ids = &model.actuator_trnid()[2 * actuator..2 * actuator + 2];
        let id = usize::try_from(ids[0]).ok()?;
        match model.actuator_trntype()[actuator] {
            0 | 1 => Some(vec![model.jnt_bodyid()[id] as usize]), // mjTRN_JOINT, mjTRN_JOINTINPARENT
            2 | 4 => Some(
                // mjTRN_SLIDERCRANK, mjTRN_SITE
                (ids.iter().filter_map(|i| usize::try_from(*i).ok()))
                    .map(|site| model.site_bodyid()[site] as usize)
                    .collect(),
            ),
            3 => Some(self.tendon(id)), // mjTRN_TENDON
            _ => None,
        }
    }

    /// Bodies that an equality holds together; none: any.
    fn equality(&self, equality: usize) -> Option<Vec<usize>> {
        let model = self.model;
        let ids = [model.eq_obj1id()[equality], model.eq_obj2id()[equality]];
        let ids = ids.iter().filter_map(|i| usize::try_from(*i).ok());
        Some(match model.eq_type()[equality] {
            0 | 1 => ids.collect(), // mjEQ_CONNECT, mjEQ_WELD
            2 => ids.map(|j| model.jnt_bodyid()[j] as usize).collect(), // mjEQ_JOINT
            3 => ids.flat_map(|t| self.tendon(t)).collect(), // mjEQ_TENDON
            _ => return None,
        })
    }

    /// Bodies of a sensor, its own first; none: any.
    fn sensor_bodies(&self, sensor: usize) -> Option<Vec<usize>> {
        let model = self.model;
        let of = |kind: i32, id: i32| -> Option<Vec<usize>> {
            let id = usize::try_from(id).ok()?;
            match kind {
                1 | 2 => Some(vec![id]), // mjOBJ_BODY, mjOBJ_XBODY
                3 => Some(vec![model.jnt_bodyid()[id] as usize]),
                5 => Some(vec![model.geom_bodyid()[id] as usize]),
                6 => Some(vec![model.site_bodyid()[id] as usize]),
                7 => Some(vec![model.cam_bodyid()[id] as usize]),
                17 => Some(self.tendon(id)),
                18 => self.transmission(id),
                _ => None,
            }
        };
        let (kind, reference) = (
            model.sensor_objtype()[sensor],
            model.sensor_reftype()[sensor],
        );
        let mut out = of(kind, model.sensor_objid()[sensor]).filter(|b| !b.is_empty())?;
        if reference != 0 {
            out.append(&mut of(reference, model.sensor_refid()[sensor])?);
        }
        Some(out)
    }
}
