//! The numbers of PDOs and heartbeat producers of a node, as a type: it decides the lengths of the node's lists.

use core::{array, fmt::Debug};

use crate::object_dictionary::Entry;

/// The numbers of PDOs and heartbeat producers of a node, which are those of its
/// [`Application`](crate::Application). [`Count`](crate::Count) implements it, and nothing else.
pub trait Numbers: sealed::Sealed + Copy + Debug {
    /// The number of TPDOs.
    const TPDOS: usize;
    /// The number of RPDOs.
    const RPDOS: usize;
    /// The number of nodes whose heartbeat can be watched.
    const PRODUCERS: usize;
    /// The rows of the object dictionary for them in ascending order, in tables that begin with a sub-index 0.
    #[doc(hidden)]
    const TABLES: [&'static [Entry]; 7];

    /// Something for each TPDO.
    #[doc(hidden)]
    type Tpdos<T: Element>: List<T>;
    /// Something for each RPDO.
    #[doc(hidden)]
    type Rpdos<T: Element>: List<T>;
    /// Something for each node whose heartbeat can be watched.
    #[doc(hidden)]
    type Producers<T: Element>: List<T>;
}

/// What a [`List`] has.
pub trait Element: Copy + Debug {
    /// The value in a place that is not in use.
    const UNUSED: Self;
}

/// An array.
pub trait List<T>: Copy + Debug + AsRef<[T]> + AsMut<[T]> {
    /// An array of which nothing is in use.
    const UNUSED: Self;

    /// The array of what this returns for each place.
    fn from_fn(element: impl FnMut(usize) -> T) -> Self;
}

/// A COB-ID.
impl Element for u16 {
    const UNUSED: Self = 0;
}

impl<T: Element, const N: usize> List<T> for [T; N] {
    const UNUSED: Self = [T::UNUSED; N];

    fn from_fn(element: impl FnMut(usize) -> T) -> Self {
        array::from_fn(element)
    }
}

pub(crate) mod sealed {
    pub trait Sealed {}
}
