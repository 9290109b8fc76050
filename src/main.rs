use phantom::*;
fn main() {
    let args: Vec<String> = std::env::args().collect();
    let config: train::config::TrainConfig = toml::from_str(&std::fs::read_to_string(&args[1]).unwrap()).unwrap();
    let iters = config.train.iterations;
    let model = mujoco::Model::from_xml_path(args.get(2).map_or("xml/phantom.xml", |s| s.as_str())).unwrap();
    let mut cpu = 0.0; let mut t = train::Trainer::new(model, config, std::env::var("T").map_or(2, |t| t.parse().unwrap())).unwrap();
    for _ in 0..iters {
        let r = t.advance().unwrap();
        let u = r.update.as_ref();
        cpu += r.rollout_s + r.update_s; print!("cpu {cpu:.0} {:3} R {:.3} d {:.2} df {:.2} s {:.3} t {:.1}+{:.2}+{:.2} tot {:.0} div {}", r.iteration, r.reward, r.distance_cm, r.final_distance_cm, r.sigma, r.rollout_s, r.update_s, r.evaluate_s, t.checkpoint().seconds, r.diverged.len());
        match u { Ok(u) => { print!(" kl {:.4} cos {:.2}", u.kl_measured, u.half_cosine); for g in &u.group_cosines { print!(" {}:{:.2}", &g.0[..g.0.len().min(8)], g.1); }
            print!(" clip {:.3}", u.clipped_share); if let Some(f) = u.value_fit { print!(" ev {:.3} cond {:.0e}", f.explained_variance, f.condition); } }, Err(e) => print!(" {e}") }
        if let Some(e) = &r.evaluation { print!(" EVAL {:.2}±{:.2}", e.mean_distance_cm, e.std_cm); }
        println!();
    }
    std::fs::write("/tmp/policy.json", serde_json::to_string(&t.checkpoint().policy).unwrap()).unwrap();
}
