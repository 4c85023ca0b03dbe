//! The numbers of PDOs and heartbeat producers of a node, as a type: it decides the lengths of the node's lists.

use core::{array, fmt::Debug};

use crate::{
    Application,
    heartbeat::consumer::{self, Producer},
    object_dictionary::Entry,
    pdo::{self, Pdo},
};

/// The numbers of PDOs and heartbeat producers of a node, which are those of its [`Application`]. [`Count`] implements
/// it, and nothing else.
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

/// These numbers: each 0 to 16.
#[derive(Clone, Copy, Debug)]
pub enum Count<const TPDOS: usize, const RPDOS: usize, const PRODUCERS: usize> {}

impl<const TPDOS: usize, const RPDOS: usize, const PRODUCERS: usize> Numbers
    for Count<TPDOS, RPDOS, PRODUCERS>
{
    const TPDOS: usize = TPDOS;
    const RPDOS: usize = RPDOS;
    const PRODUCERS: usize = PRODUCERS;
    const TABLES: [&'static [Entry]; 7] = {
        let [cob_id, overflow, rpdos, rpdo_mappings, tpdos, tpdo_mappings] =
            pdo::Tables::<TPDOS, RPDOS>::ALL;
        let producers = consumer::Rows::<PRODUCERS>::ALL;
        [cob_id, producers, overflow, rpdos, rpdo_mappings, tpdos, tpdo_mappings]
    };

    type Tpdos<T: Element> = [T; TPDOS];
    type Rpdos<T: Element> = [T; RPDOS];
    type Producers<T: Element> = [T; PRODUCERS];
}

/// The numbers with the PDOs that an application declares.
#[doc(hidden)]
pub trait Declares<A: ?Sized>: Numbers {
    /// The TPDOs of a new device.
    const DECLARED_TPDOS: Self::Tpdos<Pdo>;
    /// The RPDOs of a new device.
    const DECLARED_RPDOS: Self::Rpdos<Pdo>;
    /// The entries of the heartbeat consumer of a new device.
    const DECLARED_PRODUCERS: Self::Producers<Producer>;
}

/// A wrong declaration does not compile.
impl<A: Application, const TPDOS: usize, const RPDOS: usize, const PRODUCERS: usize> Declares<A>
    for Count<TPDOS, RPDOS, PRODUCERS>
{
    const DECLARED_TPDOS: [Pdo; TPDOS] = pdo::declared_tpdos::<A, TPDOS>();
    const DECLARED_RPDOS: [Pdo; RPDOS] = pdo::declared_rpdos::<A, RPDOS>();
    const DECLARED_PRODUCERS: [Producer; PRODUCERS] = consumer::declared::<A, PRODUCERS>();
}

/// What a [`List`] has.
#[doc(hidden)]
pub trait Element: Copy + Debug {
    /// The value in a place that is not in use.
    const UNUSED: Self;
}

/// An array.
#[doc(hidden)]
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

mod sealed {
    pub trait Sealed {}

    impl<const TPDOS: usize, const RPDOS: usize, const PRODUCERS: usize> Sealed
        for super::Count<TPDOS, RPDOS, PRODUCERS>
    {
    }
}
