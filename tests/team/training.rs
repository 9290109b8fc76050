use std::sync::Arc;

use phantom::npg::fisher::FisherMode;
use phantom::team::{Team, TeamError};
use phantom::train::config::TrainConfig;
use phantom::train::{Checkpoint, IterationRecord, TrainError, Trainer};

use crate::common::team::together;
use crate::common::{phantom_model, unlimited_model};

fn config() -> TrainConfig {
    let mut config = TrainConfig::default();
    config.train.trajectories = 44;
    config.train.trajectory_s = 0.16;
    config.train.evaluate_every = 2;
    config.train.evaluation_rollouts = 3;
    config.train.object_mass_sigma_kg = 0.02;
    config.npg.value_stride = 1;
    config
}

fn trainer(team: Arc<Team>, config: &TrainConfig, threads: usize) -> Trainer {
    Trainer::in_team(team, phantom_model(), config.clone(), threads).expect("trainer")
}

/// All that has to be the same; the clock and the messages are not.
fn bits(state: &Checkpoint, record: &IterationRecord) -> String {
    let timeless = Checkpoint {
        seconds: 0.0,
        ..state.clone()
    };
    let record = IterationRecord {
        rollout_s: 0.0,
        update_s: 0.0,
        evaluate_s: 0.0,
        message_bytes: 0,
        message_s: 0.0,
        ..record.clone()
    };
    format!(
        "{} {record:?}",
        serde_json::to_string(&timeless).expect("json")
    )
}

/// The last of `iterations`, and the bytes it sent.
fn run(team: Arc<Team>, config: &TrainConfig, threads: usize, iterations: usize) -> (String, u64) {
    let mut trainer = trainer(team, config, threads);
    for _ in 1..iterations {
        trainer.advance().expect("iteration");
    }
    let record = trainer.advance().expect("iteration");
    assert!(record.update.is_ok(), "{:?}", record.update);
    (bits(trainer.checkpoint(), &record), record.message_bytes)
}

#[test]
fn any_number_of_processes_and_threads_gives_the_same_bits() {
    let worst = {
        let mut config = config();
        config.npg.epopt_epsilon = 0.3;
        config.npg.fisher = FisherMode::Empirical;
        config.train.growth_cosine = 0.9;
        config
    };
    for config in [config(), worst] {
        let (alone, bytes) = run(Arc::new(Team::alone()), &config, 2, 2);
        assert_eq!(bytes, 0);
        for (size, threads) in [(2, 1), (3, 2), (4, 1), (11, 1)] {
            for (rank, (found, bytes)) in together(size, |team| run(team, &config, threads, 2))
                .into_iter()
                .enumerate()
            {
                assert!(found == alone, "process {rank} of {size} differs");
                assert!(bytes > 0);
            }
        }
    }
}

#[test]
fn messages_do_not_grow_with_the_samples() {
    let bytes = |trajectory_s: f64| {
        let mut config = config();
        config.train.trajectory_s = trajectory_s;
        together(3, |team| run(team, &config, 1, 1).1)[0]
    };
    let (short, long) = (bytes(0.16), bytes(0.48));
    // how often outliers are limited depends on the data: a few sums of two numbers
    assert!(short.abs_diff(long) < short / 500, "{short} {long}");
}

#[test]
fn a_state_of_its_own_is_noticed() {
    let errors = together(3, |team| {
        let odd = team.rank() == 2;
        let mut trainer = trainer(team, &config(), 1);
        if odd {
            let mut state = trainer.checkpoint().clone();
            let mut theta = state.policy.parameters();
            theta[0] = 1e-9;
            state.policy.set_parameters(&theta).expect("finite");
            trainer.restore(state).expect("sound");
        }
        trainer.advance().expect_err("not the same")
    });
    for error in errors {
        assert!(
            matches!(error, TrainError::Team(TeamError::Differs { rank: 2, .. })),
            "{error}"
        );
    }
}

#[test]
fn breakdowns_are_collected() {
    let broken = |team: Arc<Team>| {
        let trainer = Trainer::in_team(team, unlimited_model(), config(), 1);
        let mut trainer = trainer.expect("trainer");
        let mut state = trainer.checkpoint().clone();
        let mut theta = state.policy.parameters();
        theta[36] = 1e200; // beyond what the engine takes
        state.policy.set_parameters(&theta).expect("finite");
        trainer.restore(state).expect("sound");
        let error = trainer.advance().expect_err("all broken").to_string();
        let breakdowns: Vec<_> = trainer.unreported_breakdowns().cloned().collect();
        (error, breakdowns)
    };
    let alone = broken(Arc::new(Team::alone()));
    assert_eq!(alone.0, "all 44 trajectories diverged");
    assert_eq!(alone.1.len(), 44);
    for found in together(3, broken) {
        assert!(found == alone, "{}", found.0);
    }
}
