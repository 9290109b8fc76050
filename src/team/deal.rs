use super::{Team, TeamError};

/// Trajectories a lane has at least, where there are enough: fewer make smaller matrix products and more branches.
const PER_LANE: usize = 8;
/// Lanes there are at least.
const MIN_LANES: usize = 8;

static ALONE: Team = Team::alone();

/// A batch of trajectories, dealt to the processes of a team.
///
/// Trajectory `i` of `n` belongs to lane `i mod n_lane`, with `n_lane` a power of two that depends on `n` alone. The
/// lanes of even trajectories come first in the tree, those of odd ones then, and each process has a run of lanes. Where
/// there are more processes than lanes, some have none.
pub struct Deal<'a> {
    team: &'a Team,
    mine: Vec<usize>,
    lanes: Vec<Vec<usize>>, // (n_lane) places of each lane's trajectories; empty: another process's
}

impl Deal<'static> {
    /// All of `n` trajectories for this process.
    pub fn alone(n: usize) -> Self {
        Self::new(&ALONE, n)
    }
}

impl<'a> Deal<'a> {
    /// Deal trajectories 0 to `n` - 1.
    pub fn new(team: &'a Team, n: usize) -> Self {
        let n_lane = 1 << (n / PER_LANE).max(MIN_LANES).ilog2();
        let mut deal = Self {
            team,
            mine: Vec::new(),
            lanes: vec![Vec::new(); n_lane],
        };
        let mut is_mine = vec![false; n_lane];
        for leaf in 0..n_lane {
            is_mine[deal.lane(leaf)] = deal.owner(leaf) == team.rank();
        }
        for index in (0..n).filter(|index| is_mine[index % n_lane]) {
            deal.lanes[index % n_lane].push(deal.mine.len());
            deal.mine.push(index);
        }
        deal
    }

    /// The team.
    pub fn team(&self) -> &'a Team {
        self.team
    }

    /// Indices of this process's trajectories, ascending. Elsewhere a position in this list is called a place.
    pub fn mine(&self) -> &[usize] {
        &self.mine
    }

    /// Sums over the trajectories of even and over those of odd index, the same bits for everyone and in any team.
    ///
    /// `lane` sums one lane's trajectories, given by their places in [`Self::mine`]; all its sums have the same length.
    ///
    /// # Errors
    /// When processes cannot reach each other.
    pub fn halves(
        &self,
        lane: impl Fn(&[usize]) -> Vec<f64> + Sync,
    ) -> Result<[Vec<f64>; 2], TeamError> {
        let owner = |leaf| self.owner(leaf);
        let leaf = |leaf| lane(&self.lanes[self.lane(leaf)]);
        let (half, all) = (self.lanes.len() / 2, self.lanes.len());
        let even = self.team.tree(0..half, &owner, &leaf, &add)?;
        let odd = self.team.tree(half..all, &owner, &leaf, &add)?;
        let odd = self.team.carry(odd, self.owner(half), 0)?;
        self.team
            .from_first(even.zip(odd).map(|(even, odd)| [even, odd]))
    }

    /// As [`Self::halves`], added up.
    ///
    /// # Errors
    /// When processes cannot reach each other.
    pub fn total(&self, lane: impl Fn(&[usize]) -> Vec<f64> + Sync) -> Result<Vec<f64>, TeamError> {
        let [even, odd] = self.halves(lane)?;
        Ok(add(even, odd))
    }

    /// Sums of a few numbers a trajectory, given its place.
    ///
    /// # Errors
    /// When processes cannot reach each other.
    pub fn totals<const N: usize>(
        &self,
        numbers: impl Fn(usize) -> [f64; N] + Sync,
    ) -> Result<[f64; N], TeamError> {
        let total = self.total(|lane| {
            let mut sums = vec![0.0; N];
            for &place in lane {
                for (sum, number) in sums.iter_mut().zip(numbers(place)) {
                    *sum += number;
                }
            }
            sums
        })?;
        Ok(std::array::from_fn(|i| total[i]))
    }

    /// The lane at a leaf of the tree.
    fn lane(&self, leaf: usize) -> usize {
        let half = self.lanes.len() / 2;
        2 * (leaf % half) + leaf / half
    }

    /// The process that has a leaf.
    fn owner(&self, leaf: usize) -> usize {
        leaf * self.team.size() / self.lanes.len()
    }
}

fn add(mut a: Vec<f64>, b: Vec<f64>) -> Vec<f64> {
    debug_assert_eq!(a.len(), b.len());
    for (a, b) in a.iter_mut().zip(b) {
        *a += b;
    }
    a
}
