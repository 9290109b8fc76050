//! Accessors of every array of mjModel and mjData, generated from the table in `mjxmacro.h`.
//!
//! Their one-line descriptions are the comments of the installed headers.
#![allow(clippy::doc_markdown)] // those comments know no backticks

use super::{Data, Model, ModelEdit, ffi};
use std::slice;

/// A slice over one C array.
///
/// # Safety
/// `ptr` points to `len` initialised values that live, and are not written, during `'a`.
pub(super) unsafe fn view<'a, T>(ptr: *const T, len: usize) -> &'a [T] {
    if len == 0 || ptr.is_null() {
        return &[];
    }
    // SAFETY: the caller's promise.
    unsafe { slice::from_raw_parts(ptr, len) }
}

/// A mutable slice over one C array.
///
/// # Safety
/// `ptr` points to `len` initialised values that live, and are accessed by nobody else, during `'a`.
pub(super) unsafe fn view_mut<'a, T>(ptr: *mut T, len: usize) -> &'a mut [T] {
    if len == 0 || ptr.is_null() {
        return &mut [];
    }
    // SAFETY: the caller's promise.
    unsafe { slice::from_raw_parts_mut(ptr, len) }
}

macro_rules! model_sizes {
    ($([$doc:literal] $name:ident;)+) => {
        /// Sizes.
        impl Model {
            $(#[doc = $doc]
            #[allow(non_snake_case)]
            #[inline]
            pub fn $name(&self) -> usize { self.raw().$name.max(0) as usize })+

            /// Every size by name.
            pub fn sizes(&self) -> Vec<(&'static str, usize)> {
                vec![$((stringify!($name), self.$name())),+]
            }
        }
    };
}
ffi::for_each_model_size!(model_sizes);

macro_rules! model_arrays {
    ($m:ident, $([$doc:literal] $element:tt $name:ident ($rows:expr) ($cols:expr);)+) => {
        /// Arrays, row by row; shapes in brackets.
        impl Model {
            $(#[doc = $doc]
            #[allow(non_snake_case)]
            #[inline]
            pub fn $name(&self) -> &[$element] {
                let $m = self.raw();
                // SAFETY: invariants 1 and 3.
                unsafe { view($m.$name.cast(), ($rows) * ($cols)) }
            })+

            /// The first size, index or flag in which two models differ.
            pub(super) fn structure_difference(&self, other: &Self) -> Option<String> {
                for ((name, a), (_, b)) in self.sizes().into_iter().zip(other.sizes()) {
                    // names and user fields may differ in length
                    if a != b && name != "nnames" && name != "nbuffer" {
                        return Some(format!("{name} {a} and {b}"));
                    }
                }
                $(if differs!($element, stringify!($name), self.$name(), other.$name()) {
                    return Some(concat!(stringify!($name), " differs").into());
                })+
                None
            }
        }
    };
}

/// Indices and flags must agree; numbers, colours, names and text need not.
macro_rules! differs {
    (f64, $name:expr, $a:expr, $b:expr) => {
        false
    };
    (f32, $name:expr, $a:expr, $b:expr) => {
        false
    };
    (u8, $name:expr, $a:expr, $b:expr) => {
        !matches!($name, "names" | "text_data" | "tex_rgb") && $a != $b
    };
    (i32, $name:expr, $a:expr, $b:expr) => {
        !$name.starts_with("name_") && $a != $b
    };
}
ffi::for_each_model_array!(model_arrays, m);

macro_rules! model_numbers {
    ($m:ident, $([$doc:literal] f64 $name:ident ($rows:expr) ($cols:expr);)+) => {
        /// Arrays of doubles by name.
        impl Model {
            /// The array of doubles called `name`, row by row, with its rows and columns.
            pub fn numeric_field_shaped(&self, name: &str) -> Option<(&[f64], (usize, usize))> {
                let $m = self.raw();
                match name {
                    $(stringify!($name) => Some((self.$name(), ($rows, $cols))),)+
                    _ => None,
                }
            }

            /// Names of all arrays of doubles.
            pub const NUMERIC_FIELDS: &'static [&'static str] = &[$(stringify!($name)),+];

            /// Copies every double of `from`, a model of the same structure, without allocating.
            pub(super) fn copy_numbers(&mut self, from: &Self) {
                $({
                    let $m = self.raw_mut();
                    let (ptr, len) = ($m.$name, ($rows) * ($cols));
                    // SAFETY: invariants 1 and 3; `&mut self` is exclusive.
                    let target = unsafe { view_mut(ptr, len) };
                    target.copy_from_slice(from.$name());
                })+
                self.raw_mut().opt = from.raw().opt;
                self.raw_mut().stat = from.raw().stat;
                self.unchecked.clone_from(&from.unchecked);
            }
        }
    };
}
ffi::for_each_model_f64!(model_numbers, m);

impl Model {
    /// The array of doubles called `name`, row by row; for instance `body_mass`.
    pub fn numeric_field(&self, name: &str) -> Option<&[f64]> {
        self.numeric_field_shaped(name).map(|(values, _)| values)
    }
}

macro_rules! model_edits {
    ($m:ident, $([$doc:literal] f64 $name:ident ($rows:expr) ($cols:expr);)+) => {
        /// Arrays of doubles, for writing; shapes in brackets.
        impl ModelEdit<'_> {
            $(#[doc = $doc]
            #[allow(non_snake_case)]
            pub fn $name(&mut self) -> &mut [f64] {
                self.touch(stringify!($name));
                let $m = self.model.raw_mut();
                let (ptr, len) = ($m.$name, ($rows) * ($cols));
                // SAFETY: invariants 1 and 3; `&mut self` is exclusive.
                unsafe { view_mut(ptr, len) }
            })+

            /// The array of doubles called `name`, for writing. `None` for arrays of other types,
            /// and for `wrap_prm`, in which C looks for site indices.
            pub fn numeric_field_mut(&mut self, name: &str) -> Option<&mut [f64]> {
                match name {
                    $(stringify!($name) => Some(self.$name()),)+
                    _ => None,
                }
            }
        }
    };
}
ffi::for_each_model_editable!(model_edits, m);

macro_rules! data_arrays {
    ($m:ident, $([$doc:literal] $element:tt $name:ident ($rows:expr) ($cols:expr);)+) => {
        /// Arrays, row by row; shapes in brackets. Those counted by `njmax` have the allocated
        /// length: only the first [`Data::nefc`] rows mean anything.
        impl Data {
            $(#[doc = $doc]
            #[allow(non_snake_case)]
            #[inline]
            pub fn $name(&self) -> &[$element] {
                let $m = self.model().raw();
                // SAFETY: invariants 2 and 3; MuJoCo writes only through `&mut self`.
                unsafe { view(self.raw().$name.cast(), ($rows) * ($cols)) }
            })+
        }
    };
}
ffi::for_each_data_array!(data_arrays, m);

macro_rules! data_inputs {
    ($($name:ident $name_mut:ident;)+) => {
        /// Inputs, for writing; shapes as in the reading methods.
        impl Data {
            $(#[doc = concat!("[`Data::", stringify!($name), "`] for writing.")]
            #[inline]
            pub fn $name_mut(&mut self) -> &mut [f64] {
                let len = self.$name().len();
                // SAFETY: as above, and `&mut self` is exclusive.
                unsafe { view_mut(self.raw().$name, len) }
            })+
        }
    };
}

data_inputs! {
    qpos qpos_mut;
    qvel qvel_mut;
    act act_mut;
    ctrl ctrl_mut;
    qacc qacc_mut;
    qacc_warmstart qacc_warmstart_mut;
    qfrc_applied qfrc_applied_mut;
    xfrc_applied xfrc_applied_mut;
    mocap_pos mocap_pos_mut;
    mocap_quat mocap_quat_mut;
    userdata userdata_mut;
}
