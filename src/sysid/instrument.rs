//! Recordings without what their instruments add: biases, gains and delays held in the parameters.
//!
//! ```text
//! true value at time t − delay = (reading at t − bias) / gain        command in force at t: given at t − delay
//! ```

use super::parameter::{Instrument, Parameters, Role};
use crate::mjcf::glob;
use crate::recording::{Channel, Kind, Recording, Stream};

/// `recording` as perfect instruments would have made it, were the parameters at their `start`.
pub(crate) fn corrected(recording: &Recording, parameters: &Parameters) -> Recording {
    let mut out = Recording {
        meta: recording.meta.clone(),
        streams: Vec::new(),
    };
    for stream in &recording.streams {
        // channels of a stream that are late by the same time stay together
        let mut groups: Vec<(i64, Vec<usize>)> = Vec::new();
        for (column, channel) in stream.channels.iter().enumerate() {
            let late = value(parameters, Instrument::Delay, channel, 0.0);
            let acts = value(parameters, Instrument::CommandDelay, channel, 0.0);
            let shift = ((acts - late) * 1e9).round() as i64;
            match groups.iter_mut().find(|(s, _)| *s == shift) {
                Some((_, columns)) => columns.push(column),
                None => groups.push((shift, vec![column])),
            }
        }
        for (i, (shift, columns)) in groups.iter().enumerate() {
            let channels: Vec<Channel> = columns
                .iter()
                .map(|&c| stream.channels[c].clone())
                .collect();
            let name = if i == 0 {
                stream.name.clone()
            } else {
                format!("{} {i}", stream.name)
            };
            let correction: Vec<(f64, f64)> = (channels.iter())
                .map(|c| {
                    let bias = value(parameters, Instrument::Bias, c, 0.0);
                    (bias, value(parameters, Instrument::Gain, c, 1.0))
                })
                .collect();
            let mut part = Stream::new(&name, stream.rate_hz, channels);
            for (k, stamp) in stream.stamps_ns.iter().enumerate() {
                let row = stream.row(k);
                let row: Vec<f64> = (columns.iter().zip(&correction))
                    .map(|(&c, (bias, gain))| (row[c] - bias) / gain)
                    .collect();
                part.push(stamp + shift, &row);
            }
            out.streams.push(part);
        }
    }
    out
}

fn value(parameters: &Parameters, what: Instrument, channel: &Channel, otherwise: f64) -> f64 {
    let control = what == Instrument::CommandDelay;
    if control != (channel.kind == Kind::Control) {
        return otherwise;
    }
    let found = parameters.all.iter().find(|p| {
        matches!(&p.role, Role::Instrument(i, pattern) if *i == what && glob::matches(pattern, &channel.name))
    });
    found.map_or(otherwise, |p| p.start)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mujoco::Model;
    use crate::sysid::parameter::ParameterRule;

    #[test]
    fn takes_biases_gains_and_delays_out() {
        let model = Model::from_xml_str(
            r#"<mujoco><worldbody><body><joint name="j"/><geom size=".1"/></body></worldbody>
            <actuator><motor name="m" joint="j"/></actuator></mujoco>"#,
        )
        .expect("loads");
        let rule = |element: &str, attribute: &str, start| ParameterRule {
            start: Some(start),
            ..ParameterRule::new(element, attribute)
        };
        let rules = [
            rule("channel/a", "bias", 0.5),
            rule("channel/a", "gain", 2.0),
            rule("channel/b", "delay", 0.25),
            rule("control/*", "delay", 0.125),
        ];
        let names = ["a".to_owned(), "b".to_owned()];
        let parameters = Parameters::new(&model, &rules, &names).expect("fits");
        let channel = |name: &str, kind| Channel {
            name: name.into(),
            kind,
            unit: String::new(),
            noise_sigma: None,
        };
        let channels = vec![
            channel("a", Kind::Sensor),
            channel("b", Kind::Sensor),
            channel("m", Kind::Control),
        ];
        let mut stream = Stream::new("all", None, channels);
        stream.push(1_000_000_000, &[4.5, 3.0, 7.0]);
        let recording = Recording {
            streams: vec![stream],
            ..Recording::default()
        };
        let out = corrected(&recording, &parameters);
        let read = |name| {
            let (stream, column) = out.channel(name).expect("there");
            (stream.time(0), stream.row(0)[column])
        };
        assert_eq!(read("a"), (1.0, 2.0));
        assert_eq!(read("b"), (0.75, 3.0));
        assert_eq!(read("m"), (1.125, 7.0));
    }
}
