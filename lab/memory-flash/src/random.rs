//! Random numbers for tests, and which share of its cases a test takes. Every test prints its seed, so that a failure can
//! be repeated.

use std::{
    env,
    hash::{BuildHasher, RandomState},
    ops::Range,
};

/// The step with which a test goes through its cases: each `nth`, or all if the environment has `FULL`, as in
/// `.ci/run campaigns`.
pub fn every(nth: usize) -> usize {
    if env::var_os("FULL").is_some() { 1 } else { nth }
}

/// A generator of random numbers (SplitMix64).
#[derive(Clone, Debug)]
pub struct Random(u64);

impl Random {
    /// A generator with a new seed, or with the one in the environment variable `SEED`. Prints the seed.
    pub fn from_environment() -> Self {
        let seed = Self::seed();
        println!("SEED={seed}");
        Self(seed)
    }

    /// A new seed, or the one in the environment variable `SEED`.
    pub fn seed() -> u64 {
        match env::var("SEED") {
            Ok(seed) => seed.parse().expect("SEED is a number"),
            Err(_) => RandomState::new().hash_one(0),
        }
    }

    pub fn from_seed(seed: u64) -> Self {
        Self(seed)
    }

    pub fn u64(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let z = (self.0 ^ self.0 >> 30).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        let z = (z ^ z >> 27).wrapping_mul(0x94D0_49BB_1331_11EB);
        z ^ z >> 31
    }

    pub fn u32(&mut self) -> u32 {
        (self.u64() >> 32) as u32
    }

    pub fn byte(&mut self) -> u8 {
        (self.u64() >> 56) as u8
    }

    pub fn bytes<const N: usize>(&mut self) -> [u8; N] {
        std::array::from_fn(|_| self.byte())
    }

    /// A number in `range`, which is not empty.
    pub fn within(&mut self, range: Range<u64>) -> u64 {
        range.start + self.u64() % (range.end - range.start)
    }

    /// True with a probability of 1 in `n`.
    pub fn one_in(&mut self, n: u64) -> bool {
        self.u64().is_multiple_of(n)
    }

    pub fn pick<T: Copy>(&mut self, from: &[T]) -> T {
        from[self.within(0..from.len() as u64) as usize]
    }
}
