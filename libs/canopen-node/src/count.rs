//! A number of PDOs and heartbeat producers as a type, and what an application declares for each of them.

use crate::{
    Application,
    heartbeat::{self, Producer},
    numbers::{Element, Numbers, sealed::Sealed},
    object_dictionary::Entry,
    pdo::{self, Pdo},
};

/// These numbers: each 0 to 16.
#[derive(Clone, Copy, Debug)]
pub enum Count<const TPDOS: usize, const RPDOS: usize, const PRODUCERS: usize> {}

impl<const TPDOS: usize, const RPDOS: usize, const PRODUCERS: usize> Sealed
    for Count<TPDOS, RPDOS, PRODUCERS>
{
}

impl<const TPDOS: usize, const RPDOS: usize, const PRODUCERS: usize> Numbers
    for Count<TPDOS, RPDOS, PRODUCERS>
{
    const TPDOS: usize = TPDOS;
    const RPDOS: usize = RPDOS;
    const PRODUCERS: usize = PRODUCERS;
    const TABLES: [&'static [Entry]; 7] = {
        let [cob_id, overflow, rpdos, rpdo_mappings, tpdos, tpdo_mappings] =
            pdo::Tables::<TPDOS, RPDOS>::ALL;
        let producers = heartbeat::Rows::<PRODUCERS>::ALL;
        [cob_id, producers, overflow, rpdos, rpdo_mappings, tpdos, tpdo_mappings]
    };

    type Tpdos<T: Element> = [T; TPDOS];
    type Rpdos<T: Element> = [T; RPDOS];
    type Producers<T: Element> = [T; PRODUCERS];
}

impl<const TPDOS: usize, const RPDOS: usize, const PRODUCERS: usize>
    Count<TPDOS, RPDOS, PRODUCERS>
{
    /// Checks what an application declares beside its objects; panics, at compile time, with what is wrong.
    #[doc(hidden)]
    pub const fn check<A: Application>() {
        let _ = pdo::declared_tpdos::<A, TPDOS>();
        let _ = pdo::declared_rpdos::<A, RPDOS>();
        let _ = heartbeat::declared::<A, PRODUCERS>();
    }
}

/// The numbers with the PDOs that an application declares.
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
    const DECLARED_PRODUCERS: [Producer; PRODUCERS] = heartbeat::declared::<A, PRODUCERS>();
}
