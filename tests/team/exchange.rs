use std::fmt;

use phantom::team::{Deal, Team, TeamError};
use proptest::prelude::*;

use crate::common::team::together;

/// Numbers of very different size, so that every order of adding them has another sum.
fn number(index: usize) -> f64 {
    (1.7 * index as f64).sin() * 10_f64.powi(index as i32 % 17 - 8)
}

fn halves(team: &Team, n: usize) -> [Vec<f64>; 2] {
    let deal = Deal::new(team, n);
    let sum = |lane: &[usize]| {
        let values = lane.iter().map(|&place| number(deal.mine()[place]));
        vec![values.sum(), lane.len() as f64]
    };
    deal.halves(sum).expect("all there")
}

#[test]
fn every_trajectory_is_dealt_once_and_evenly() {
    for n in [0, 1, 7, 16, 64, 600, 1201] {
        for size in [1, 2, 3, 4, 7, 8, 64] {
            let hands = together(size, |team| Deal::new(&team, n).mine().to_vec());
            for hand in &hands {
                assert!(hand.is_sorted());
            }
            if size.is_power_of_two() && n % 64 == 0 && size <= 8 {
                assert!(hands.iter().all(|hand| hand.len() == n / size));
            }
            let most = hands.iter().map(Vec::len).max().unwrap_or(0);
            if size <= 8 {
                assert!(most <= n / size + n / 8 + 1, "{n} {size}: {most}");
            }
            let mut all = hands.concat();
            all.sort_unstable();
            assert!(all.into_iter().eq(0..n), "{n} {size}");
        }
    }
}

#[test]
fn sums_have_the_same_bits_in_every_team() {
    for n in [0, 5, 33, 600] {
        let alone = halves(&Team::alone(), n);
        assert_eq!(
            [alone[0][1], alone[1][1]],
            [n.div_ceil(2) as f64, (n / 2) as f64]
        );
        for (parity, half) in alone.iter().enumerate() {
            let plain: f64 = (parity..n).step_by(2).map(number).sum();
            let size: f64 = (parity..n).step_by(2).map(|i| number(i).abs()).sum();
            assert!((half[0] - plain).abs() <= 1e-14 * size);
        }
        for size in [2, 3, 4, 5, 8, 13] {
            for result in together(size, |team| halves(&team, n)) {
                assert_eq!(result, alone, "{n} trajectories, {size} processes");
            }
        }
    }
    // the test is one only if the order matters
    let backwards: f64 = (0..600).rev().step_by(2).map(number).sum();
    assert_ne!(backwards, halves(&Team::alone(), 600)[1][0]);
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]
    #[test]
    fn the_sorted_value_is_that_of_all_values(
        mut values in prop::collection::vec(prop::num::f64::ANY, 0..40),
        repeated in 0..5_usize,
        rank in 0..50_usize,
        size in 1..5_usize,
    ) {
        values.extend(values.clone().into_iter().take(repeated));
        let found = together(size, |team| {
            let mine: Vec<f64> = values.iter().skip(team.rank()).step_by(size).copied().collect();
            team.sorted_value(&mine, rank).expect("all there")
        });
        values.sort_by(f64::total_cmp);
        let expected = values.get(rank).map(|value| value.to_bits());
        prop_assert!(found.iter().all(|value| value.map(f64::to_bits) == expected));
    }
}

#[derive(Debug, PartialEq)]
enum Error {
    Own(usize),
    Team(TeamError),
}

impl fmt::Display for Error {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{self:?}")
    }
}

impl From<TeamError> for Error {
    fn from(error: TeamError) -> Self {
        Self::Team(error)
    }
}

#[test]
fn an_error_of_one_is_an_error_of_all() {
    let agreed = |failing: &[usize]| {
        together(4, |team| {
            let rank = team.rank();
            let result = if failing.contains(&rank) {
                Err(Error::Own(rank))
            } else {
                Ok(rank)
            };
            team.agree(result, |error| *error == Error::Own(2))
        })
    };
    assert_eq!(agreed(&[]), [Ok(0), Ok(1), Ok(2), Ok(3)]);
    let elsewhere = |rank, is_fatal| {
        let reason = format!("Own({rank})");
        Err(Error::Team(TeamError::Elsewhere {
            rank,
            reason,
            is_fatal,
        }))
    };
    assert_eq!(
        agreed(&[2, 3]),
        [
            elsewhere(2, true),
            elsewhere(2, true),
            Err(Error::Own(2)),
            Err(Error::Own(3))
        ]
    );
    assert_eq!(agreed(&[1])[0], elsewhere(1, false));
}

#[test]
fn who_differs_is_named() {
    let compare = |values: [f64; 3]| together(3, |team| team.same("sum", &values[team.rank()]));
    assert!(compare([0.5; 3]).iter().all(Result::is_ok));
    for found in compare([0.5, 0.5, 0.5 + f64::EPSILON]) {
        let error = found.expect_err("the last bit");
        assert!(
            error.to_string().starts_with("process 2 has another sum"),
            "{error}"
        );
        assert!(!error.is_lonely());
    }
}

#[test]
fn nobody_waits_for_who_is_gone() {
    let results = together(4, |team| {
        if team.rank() == 2 {
            return None;
        }
        Some(team.all(&1, |a: usize, b| a + b))
    });
    // 3 was to send to 2; 0 was to receive from 2; 1 waits for 0
    assert!(results.iter().flatten().all(Result::is_err), "{results:?}");
    assert!(
        results
            .iter()
            .flatten()
            .any(|r| *r == Err(TeamError::Lost { rank: 2 }))
    );
}

#[test]
fn a_message_that_is_none_is_an_error() {
    let results = together(2, |team| {
        if team.is_first() {
            team.from_first(Some(7_u8)).map(|_| String::new())
        } else {
            team.from_first(None::<String>)
        }
    });
    let error = results[1].as_ref().expect_err("a number, not a text");
    assert!(
        error.is_lonely() && error.to_string().contains("same build"),
        "{error}"
    );
}
