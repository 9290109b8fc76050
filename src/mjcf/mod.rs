//! Numbers of an MJCF model by address, in the compiled model and in its file.
//!
//! ```text
//! kind/glob attribute[component]      joint/p*_upper damping      pair/object_table friction[0]
//! ```
//!
//! [`attribute::resolve`] finds what an address means, [`edit::write`] puts values into a compiled model, and
//! [`file::rewrite`] into the text of the model file, of which nothing but those attributes changes.

pub mod attribute;
pub mod edit;
pub mod file;
pub mod glob;
pub mod inertia;

use thiserror::Error;

/// What can be wrong with an address or a model file.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
#[non_exhaustive]
pub enum MjcfError {
    /// An address means nothing in this model.
    #[error("`{element} {attribute}`: {reason}")]
    Address {
        /// `kind/glob`
        element: String,
        /// attribute
        attribute: String,
        /// what is wrong
        reason: String,
    },
    /// The model file is not well-formed XML.
    #[error("the model file is not XML: {reason}")]
    Xml {
        /// the parser's reason
        reason: String,
    },
    /// An element of the model is not written in the model file.
    #[error("{kind} `{element}` is not in the model file itself; put included files into it first")]
    NotInFile {
        /// kind of element
        kind: &'static str,
        /// its name
        element: String,
    },
    /// An actuator is written in a short form that lacks the attribute.
    #[error(
        "actuator `{element}` is a `{tag}`, which has no {attribute}; write it as a `general` actuator first"
    )]
    Shorthand {
        /// its name
        element: String,
        /// the short form
        tag: String,
        /// what it lacks
        attribute: String,
    },
}
