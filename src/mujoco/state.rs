//! The simulation state: what must be kept to continue with the same bits.
//!
//! Order: time, qpos, qvel, act, ctrl, `mocap_pos`, `mocap_quat`, userdata, `qfrc_applied`,
//! `xfrc_applied`, `qacc_warmstart`, qacc, and the memory of the model's extension. Everything else is recomputed by the next step. Warning
//! counts are not part of it.

use super::{Data, MujocoError, Result};

macro_rules! state_fields {
    ($($name:ident $name_mut:ident;)+) => {
        /// A saved state. Reusable buffer: fill it with [`Data::save_state`].
        #[derive(Debug, Clone, Default, PartialEq)]
        pub struct State {
            time: f64,
            memory: Vec<f64>,
            $($name: Vec<f64>,)+
        }

        impl State {
            $(#[doc = concat!("[`Data::", stringify!($name), "`] as saved.")]
            pub fn $name(&self) -> &[f64] { &self.$name }

            #[doc = concat!("The saved [`Data::", stringify!($name), "`], for writing.")]
            pub fn $name_mut(&mut self) -> &mut [f64] { &mut self.$name })+
        }

        impl Data {
            /// Writes the state into `state`, without allocating if it was used with this model.
            pub fn save_state(&self, state: &mut State) {
                state.time = self.time();
                state.memory.clear();
                state.memory.extend_from_slice(self.memory());
                $(state.$name.clear();
                state.$name.extend_from_slice(self.$name());)+
            }

            /// Puts a saved state back: the next step gives the same bits as it did then.
            ///
            /// # Errors
            /// [`MujocoError::Length`] if it is of a model of other sizes; nothing is changed then.
            /// [`MujocoError::Poisoned`].
            pub fn restore_state(&mut self, state: &State) -> Result<()> {
                self.usable()?;
                $(let (expected, got) = (self.$name().len(), state.$name.len());
                if expected != got {
                    return Err(MujocoError::Length { name: stringify!($name), expected, got });
                })+
                self.set_memory(&state.memory)?;
                self.set_time(state.time);
                $(self.$name_mut().copy_from_slice(&state.$name);)+
                Ok(())
            }
        }
    };
}

state_fields! {
    qpos qpos_mut;
    qvel qvel_mut;
    act act_mut;
    ctrl ctrl_mut;
    mocap_pos mocap_pos_mut;
    mocap_quat mocap_quat_mut;
    userdata userdata_mut;
    qfrc_applied qfrc_applied_mut;
    xfrc_applied xfrc_applied_mut;
    qacc_warmstart qacc_warmstart_mut;
    qacc qacc_mut;
}

impl State {
    /// Simulated time in seconds.
    pub fn time(&self) -> f64 {
        self.time
    }

    /// Sets the simulated time in seconds.
    pub fn set_time(&mut self, time: f64) {
        self.time = time;
    }

    /// [`Data::memory`] as saved.
    pub fn memory(&self) -> &[f64] {
        &self.memory
    }
}

impl Data {
    /// A copy of the state.
    pub fn state(&self) -> State {
        let mut state = State::default();
        self.save_state(&mut state);
        state
    }
}
