//! The numbers of an iteration as a row of `metrics.csv`.

use super::{Checkpoint, IterationRecord, Trainer};

const FIXED_COLUMNS: [&str; 27] = [
    "physics_steps",
    "seconds",
    "reward",
    "object_distance_cm",
    "final_distance_cm",
    "eval_distance_cm",
    "eval_std_cm",
    "trajectories",
    "step_size_delta",
    "kl_predicted",
    "kl_measured",
    "gradient_norm2",
    "half_cosine",
    "sigma_nm",
    "advantage_sigma",
    "clipped_share",
    "value_explained_variance",
    "value_condition",
    "n_diverged",
    "update_skipped",
    "physics_steps_per_s",
    "rollout_s",
    "update_s",
    "evaluate_s",
    "best_distance_cm",
    "message_bytes",
    "message_s",
];

/// All columns: the fixed ones, and the agreement of half batches over each observation group.
pub(super) fn columns(trainer: &Trainer) -> Vec<String> {
    let groups = trainer.sampler().task().observation_groups();
    let fixed = FIXED_COLUMNS.iter().map(ToString::to_string);
    fixed
        .chain(
            groups
                .iter()
                .map(|group| format!("half_cosine_{}", group.name)),
        )
        .collect()
}

/// The numbers of an iteration by column.
pub(super) fn row(record: &IterationRecord, state: &Checkpoint) -> Vec<(String, f64)> {
    let mut row: Vec<(String, f64)> = Vec::new();
    let mut put = |name: &str, value: f64| row.push((name.to_owned(), value));
    put("physics_steps", state.physics_steps as f64);
    put("seconds", state.seconds);
    put("reward", record.reward);
    put("object_distance_cm", record.distance_cm);
    put("final_distance_cm", record.final_distance_cm);
    if let Some(evaluation) = &record.evaluation {
        put("eval_distance_cm", evaluation.mean_distance_cm);
        put("eval_std_cm", evaluation.std_cm);
    }
    put("trajectories", record.n_trajectory as f64);
    put("sigma_nm", record.sigma);
    put("n_diverged", state.n_diverged as f64);
    put(
        "update_skipped",
        f64::from(u8::from(record.update.is_err())),
    );
    put(
        "physics_steps_per_s",
        record.physics_steps as f64 / record.rollout_s,
    );
    put("rollout_s", record.rollout_s);
    put("update_s", record.update_s);
    put("evaluate_s", record.evaluate_s);
    put(
        "best_distance_cm",
        state.best_distance_cm.unwrap_or(f64::NAN),
    );
    put("message_bytes", record.message_bytes as f64);
    put("message_s", record.message_s);
    if let Ok(update) = &record.update {
        put("step_size_delta", 2.0 * update.kl_predicted);
        put("kl_predicted", update.kl_predicted);
        put("kl_measured", update.kl_measured);
        put("gradient_norm2", update.gradient_norm2);
        put("half_cosine", update.half_cosine);
        put("advantage_sigma", update.advantage_sigma);
        put("clipped_share", update.clipped_share);
        if let Some(fit) = update.value_fit {
            put("value_explained_variance", fit.explained_variance);
            put("value_condition", fit.condition);
        }
        for &(name, cosine) in &update.group_cosines {
            put(&format!("half_cosine_{name}"), cosine);
        }
    }
    row
}
