//! The levels at which the voltage detector and the brown-out reset act (F405 data sheet, embedded reset and power
//! control block characteristics), in mV.

/// The chip's place within the range of the data sheet.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Thresholds {
    Lowest,
    #[default]
    Typical,
    Highest,
}

/// The lowest, the typical and the highest level.
type Range = [u32; 3];

/// A level with hysteresis.
struct Level {
    rising: Range,
    falling: Range,
}

impl Level {
    const fn new(rising: Range, falling: Range) -> Self {
        Self { rising, falling }
    }

    /// Whether the supply is too low, if it was so before or not.
    const fn is_low(&self, thresholds: Thresholds, supply_mv: u32, was_low: bool) -> bool {
        let range = if was_low { self.rising } else { self.falling };
        supply_mv < range[thresholds as usize]
    }
}

/// The levels of the voltage detector, by PLS.
const DETECTOR: [Level; 8] = [
    Level::new([2_090, 2_140, 2_190], [1_980, 2_040, 2_080]),
    Level::new([2_230, 2_300, 2_370], [2_130, 2_190, 2_250]),
    Level::new([2_390, 2_450, 2_510], [2_290, 2_350, 2_390]),
    Level::new([2_540, 2_600, 2_650], [2_440, 2_510, 2_560]),
    Level::new([2_700, 2_760, 2_820], [2_590, 2_660, 2_710]),
    Level::new([2_860, 2_930, 2_990], [2_750, 2_840, 2_920]),
    Level::new([2_960, 3_030, 3_100], [2_850, 2_930, 2_990]),
    Level::new([3_070, 3_140, 3_210], [2_950, 3_030, 3_090]),
];

/// The levels of the reset, by BOR_LEV in the option byte: level 3, 2, 1, and off, where only the power-down reset acts.
const BROWN_OUT: [Level; 4] = [
    Level::new([2_850, 2_920, 2_970], [2_750, 2_830, 2_880]),
    Level::new([2_530, 2_590, 2_630], [2_440, 2_500, 2_560]),
    Level::new([2_230, 2_290, 2_330], [2_130, 2_190, 2_240]),
    Level::new([1_640, 1_720, 1_800], [1_600, 1_680, 1_760]),
];

impl Thresholds {
    /// Whether the voltage detector finds the supply too low for its level `pls`, if it did so before or not.
    pub(super) const fn detects(self, pls: u32, supply_mv: u32, was_low: bool) -> bool {
        DETECTOR[pls as usize & 7].is_low(self, supply_mv, was_low)
    }

    /// Whether the supply keeps the chip in reset, if it did so before or not.
    pub(super) const fn reset(self, bor_lev: u32, supply_mv: u32, was_low: bool) -> bool {
        BROWN_OUT[bor_lev as usize & 3].is_low(self, supply_mv, was_low)
    }
}
