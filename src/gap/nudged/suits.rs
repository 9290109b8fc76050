//! Whether recordings want simulations that are pulled, and in which steps.
//!
//! Windows with first states of their own do not follow what a machine pushes or presses ([`super`]). Such recordings are
//! told by a free body that no motor moves of itself: something driven touches it in the motion as it was read, or its
//! readings move although, by what is known of where things are, nothing touches it yet.
//!
//! Contacts are as stiff as their time constants say, whatever the step; simulations of whole recordings therefore take
//! steps that are some times as long as the model's, up to [`LONGEST_S`], while the engine leaves these constants alone.

use std::sync::Arc;

use crate::gap::GapError;
use crate::gap::inputs::without_parameters;
use crate::gap::lying::Lying;
use crate::gap::run::Input;
use crate::mujoco::Model;
use crate::sysid::problem::Problem;
use crate::sysid::start;

/// Hz of pulls that nobody chose.
pub(in crate::gap) const USUAL_HZ: f64 = 5.0;
/// s of the longest step that is taken unasked.
const LONGEST_S: f64 = 1e-3;
/// Steps of the shortest time constant, below which the engine lengthens it.
const LEAST_STEPS: f64 = 2.0;

/// Whether a machine pushes or presses a body in these recordings.
///
/// # Errors
/// Input that does not fit together.
pub(in crate::gap) fn is_pushing(input: &Input<'_>) -> Result<bool, GapError> {
    let model = &input.model.model;
    if model.nu() == 0 || !(0..model.njnt()).any(|j| model.is_free(j)) {
        return Ok(false);
    }
    let config = without_parameters(input.config);
    let problem = Problem::new(Arc::clone(model), &config, input.train)?;
    let x = problem.parameters.start();
    let mut lying = Lying::new(&problem, &x)?;
    for trial in &problem.trials {
        let motion = start::trajectory(&problem, trial, &x)?;
        if lying.is_pushed(trial, &motion)? {
            return Ok(true);
        }
    }
    Ok(false)
}

/// s of the steps that suit simulations of whole recordings, where they are longer than the model's.
pub(in crate::gap) fn longer_steps(model: &Model) -> Option<f64> {
    let all = [
        model.geom_solref(),
        model.pair_solref(),
        model.eq_solref(),
        model.jnt_solref(),
        model.dof_solref(),
    ];
    let constants = all.into_iter().flat_map(|own| own.chunks_exact(2));
    // of stiffness and damping, which are below 0, nothing is known
    let shortest = constants.map(|own| own[0]).fold(f64::INFINITY, f64::min);
    let most = (shortest / LEAST_STEPS).min(LONGEST_S) / model.timestep();
    // a hair for what divisions round
    let times = (most * (1.0 + 1e-9)).floor();
    (times > 1.0).then_some(times * model.timestep())
}

#[cfg(test)]
mod tests {
    use super::{is_pushing, longer_steps};
    use crate::compare::Settings;
    use crate::gap::effect::ModelFile;
    use crate::gap::run::Input;
    use crate::mujoco::Model;
    use crate::recording::{Channel, Kind, Meta, Recording, Stream};
    use crate::sysid::problem::ProblemConfig;

    /// A driven finger at `finger`, in m, and a block beside it, free where `joint` says so.
    fn machine(joint: &str) -> ModelFile {
        let xml = format!(
            r#"<mujoco><option gravity="0 0 0"/><worldbody>
            <body><joint name="f" type="slide" axis="1 0 0"/><geom size=".01"/></body>
            <body name="block" pos=".05 0 0"><{joint}/><geom size=".02"/></body></worldbody>
            <actuator><motor name="m" joint="f"/></actuator>
            <sensor><jointpos name="fs" joint="f"/><framepos name="bs" objtype="body" objname="block"/></sensor></mujoco>"#
        );
        ModelFile::of_text(xml, "pusher.xml").expect("loads")
    }

    /// The finger and the block, each where it is at first and by how much it moves, m.
    fn is_pushed(joint: &str, [finger, moved]: [f64; 2], pushed: f64) -> bool {
        let model = machine(joint);
        let channel = |name: &str, kind, unit: &str, noise_sigma| Channel {
            name: name.into(),
            kind,
            unit: unit.into(),
            noise_sigma,
        };
        let reads = |name: &str| channel(name, Kind::Sensor, "m", Some(1e-4));
        let block = ["bs[0]", "bs[1]", "bs[2]"].map(reads);
        let mut stream = Stream::new(
            "all",
            Some(500.0),
            [reads("fs"), channel("m", Kind::Control, "N", None)]
                .into_iter()
                .chain(block)
                .collect(),
        );
        for k in 0..200_i64 {
            let part = k as f64 / 200.0;
            let row = [finger + moved * part, 0.0, 0.05 + pushed * part, 0.0, 0.0];
            stream.push(k * 2_000_000, &row);
        }
        let recording = Recording {
            meta: Meta::default(),
            streams: vec![stream],
        };
        let input = Input {
            model: &model,
            config: &ProblemConfig::default(),
            train: &[("all".to_owned(), recording)],
            holdout: &[],
            protocol: &Settings::default(),
        };
        is_pushing(&input).expect("fits together")
    }

    #[test]
    fn what_is_touched_or_moves_is_pushed() {
        assert!(!is_pushed("freejoint", [0.0, 0.01], 0.0));
        assert!(is_pushed("freejoint", [0.0, 0.03], 0.0)); // touched
        assert!(is_pushed("freejoint", [-0.1, 0.03], 0.01)); // moves, by whatever touches it
        assert!(!is_pushed(r#"joint type="slide""#, [0.0, 0.03], 0.01));
    }

    fn steps(timestep: &str, solref: &str) -> Option<f64> {
        let xml = format!(
            r#"<mujoco><option timestep="{timestep}"/><worldbody><body><freejoint/><geom size="0.1" solref="{solref}"/>
            </body></worldbody></mujoco>"#
        );
        longer_steps(&Model::from_xml_str(&xml).expect("loads"))
    }

    #[test]
    fn steps_are_as_long_as_contacts_allow() {
        assert_eq!(steps("0.0005", "0.02 1"), Some(0.001));
        assert_eq!(steps("0.0004", "0.02 1"), Some(0.0008));
        assert_eq!(steps("0.002", "0.02 1"), None);
        assert_eq!(steps("0.0005", "0.0015 1"), None);
        assert_eq!(steps("0.0001", "0.0005 1"), Some(0.0002));
        assert_eq!(steps("0.0005", "-5000 -50"), None);
    }
}
