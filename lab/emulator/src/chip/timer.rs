//! TIM1 to TIM14 (RM0090 chapters 17 to 20): up-counters with compare interrupts and outputs.

use super::{
    Problem,
    pwm::Pwm,
    registers::{Apb, Place, Registers},
};
use crate::{
    Time,
    can::{Clock, timing::SCALE},
};

const CR1: u32 = 0x00;
const CR2: u32 = 0x04;
const SMCR: u32 = 0x08;
const DIER: u32 = 0x0C;
const SR: u32 = 0x10;
const EGR: u32 = 0x14;
const CCMR1: u32 = 0x18;
const CCMR2: u32 = 0x1C;
const CCER: u32 = 0x20;
const CNT: u32 = 0x24;
const PSC: u32 = 0x28;
const ARR: u32 = 0x2C;
const RCR: u32 = 0x30;
const CCR1: u32 = 0x34;
const CCR4: u32 = 0x40;
const BDTR: u32 = 0x44;
const OR: u32 = 0x50;

const CEN: u32 = 1 << 0;
const URS: u32 = 1 << 2;
const OPM: u32 = 1 << 3;
const ARPE: u32 = 1 << 7;
/// OCxM and OCxPE of CCMR1 and CCMR2; CCxE and CCxP of CCER.
const OUTPUT_MODES: u32 = 0x7878;
const ENABLES: u32 = 0x3333;
/// AOE counts as MOE, which it sets at the next update.
const MOE_AOE: u32 = 1 << 15 | 1 << 14;
/// The bits of SR, EGR and DIER: the update, followed by the channels; of SR also an overcapture of channel 1.
const UPDATE: u32 = 1 << 0;
const CC1: u32 = 1 << 1;
const CC1OF: u32 = 1 << 9;
/// TIM11_OR: HSE_RTC is the input of channel 1.
const HSE_RTC: u32 = 0b10;
/// CCMR1: channel 1 captures TI1; the power of two of the edges for a capture.
const CC1S: u32 = 0b11;
const CAPTURES_TI1: u32 = 0b01;
const IC1PSC: u32 = 0b11 << 2;

/// The properties in which the timers differ.
#[derive(Debug)]
pub struct Kind {
    pub place: Place,
    channels: u8,
    max: u32,
    /// The interrupt of the update event and that of the channels.
    irqs: (u32, u32),
}

const fn kind(place: Place, channels: u8, irqs: (u32, u32)) -> Kind {
    Kind { place, channels, max: 0xFFFF, irqs }
}

/// TIM1 to TIM14 (RM0090 2.3, 7.3 and table 61).
pub static KINDS: [Kind; 14] = [
    kind((Apb::Two, 0), 4, (25, 27)),
    Kind { max: u32::MAX, ..kind((Apb::One, 0), 4, (28, 28)) },
    kind((Apb::One, 1), 4, (29, 29)),
    kind((Apb::One, 2), 4, (30, 30)),
    Kind { max: u32::MAX, ..kind((Apb::One, 3), 4, (50, 50)) },
    kind((Apb::One, 4), 0, (54, 54)),
    kind((Apb::One, 5), 0, (55, 55)),
    kind((Apb::Two, 1), 4, (44, 46)),
    kind((Apb::Two, 16), 2, (24, 24)),
    kind((Apb::Two, 17), 1, (25, 25)),
    kind((Apb::Two, 18), 1, (26, 26)),
    kind((Apb::One, 6), 2, (43, 43)),
    kind((Apb::One, 7), 1, (44, 44)),
    kind((Apb::One, 8), 1, (45, 45)),
];

/// A timer: it counts up, and has no complementary outputs, no break and no DMA. A compare value takes effect at once, also
/// if it is preloaded. Only TIM11 captures, the rising edges of HSE_RTC, without an interrupt.
#[derive(Debug)]
pub struct Timer {
    kind: &'static Kind,
    clock: Clock,
    cr1: u32,
    dier: u32,
    sr: u32,
    /// PSC as written, and as loaded by the latest update event.
    prescaler: u32,
    divider: u32,
    /// ARR as loaded, and as it waits for the next update event.
    reload: u32,
    preloaded: Option<u32>,
    /// CCMR1 and CCMR2.
    modes: [u32; 2],
    /// CCER.
    enables: u32,
    bdtr: u32,
    compare: [u32; 4],
    /// TIM11_OR, and HSE_RTC as the crystal and its divider.
    option: u32,
    hse_rtc: Option<(Clock, u32)>,
    /// The begin of the captures, and their number since then.
    captures_from: Time,
    captures: u64,
    /// The counter at `since`, the beginning of a count.
    origin: u32,
    since: Time,
    /// The number of counts since then whose events are in SR.
    seen: u64,
    /// The time of the next event that interrupts.
    deadline: Time,
    /// It does not count, as a debugger has halted the core.
    is_frozen: bool,
}

impl Timer {
    /// The state after a reset: stopped, on a clock of 16 MHz.
    pub fn new(kind: &'static Kind) -> Self {
        Self {
            kind,
            clock: Clock { hz: 16_000_000, ppm: 0 },
            cr1: 0,
            dier: 0,
            sr: 0,
            prescaler: 0,
            divider: 0,
            reload: kind.max,
            preloaded: None,
            modes: [0; 2],
            enables: 0,
            bdtr: 0,
            compare: [0; 4],
            option: 0,
            hse_rtc: None,
            captures_from: Time::ZERO,
            captures: 0,
            origin: 0,
            since: Time::ZERO,
            seen: 0,
            deadline: Time::MAX,
            is_frozen: false,
        }
    }

    /// Stops the count, or lets it go on.
    pub fn freeze(&mut self, is_frozen: bool, now: Time) {
        self.advance(now);
        self.settle(now);
        self.is_frozen = is_frozen;
        self.plan();
    }

    fn counts(&self) -> bool {
        self.cr1 & CEN != 0 && !self.is_frozen
    }

    /// Sets the clock of the timers on its bus (RM0090 7.2).
    pub fn set_clock(&mut self, clock: Clock, now: Time) {
        if self.clock != clock {
            self.advance(now);
            self.settle(now);
            self.clock = clock;
            self.plan();
        }
    }

    /// Sets the clock HSE_RTC, the crystal and its divider.
    pub fn set_hse_rtc(&mut self, hse_rtc: Option<(Clock, u32)>, now: Time) {
        if self.hse_rtc != hse_rtc {
            self.capture(now);
            self.hse_rtc = hse_rtc;
            (self.captures_from, self.captures) = (now, 0);
        }
    }

    fn has_capture(&self) -> bool {
        self.kind.place == KINDS[10].place
    }

    /// The time between two captures; `None` without an input.
    fn capture_period(&self) -> Option<Time> {
        let captures = self.option == HSE_RTC && self.modes[0] & CC1S == CAPTURES_TI1;
        let (crystal, divider) = self.hse_rtc.filter(|_| captures && self.enables & 1 == 1)?;
        let periods = u128::from(divider << ((self.modes[0] & IC1PSC) >> 2)) * SCALE;
        Some(Time::from_ps((periods / crystal.rate()) as u64))
    }

    /// Takes the captures until `now`.
    fn capture(&mut self, now: Time) {
        let Some(period) = self.capture_period() else { return };
        let captures = (now - self.captures_from).as_ps() / period.as_ps();
        if captures > self.captures && self.counts() {
            let is_lost = self.sr & CC1 != 0 || captures > self.captures + 1;
            self.sr |= if is_lost { CC1 | CC1OF } else { CC1 };
            let last = self.captures_from + period * captures;
            self.compare[0] = self.count_after(self.counts_until(last));
        }
        self.captures = captures;
    }

    /// The time of the next interrupt.
    pub fn deadline(&self) -> Time {
        self.deadline
    }

    pub fn place(&self) -> Place {
        self.kind.place
    }

    /// The levels of its interrupts as of the latest access or [`advance`](Self::advance), bit n for interrupt n.
    pub fn irqs(&self) -> u128 {
        let raised = self.sr & self.dier;
        if raised == 0 {
            return 0;
        }
        let (update, compare) = self.kind.irqs;
        u128::from(raised & UPDATE != 0) << update | u128::from(raised & !UPDATE != 0) << compare
    }

    /// The bits of SR, EGR and DIER that it has.
    fn event_bits(&self) -> u32 {
        (UPDATE << (1 + self.kind.channels)) - 1
    }

    /// Updates SR with the events until `now`.
    pub fn advance(&mut self, now: Time) {
        self.capture(now);
        loop {
            let counts = self.counts_until(now);
            let passed = counts.saturating_sub(self.seen);
            if passed == 0 {
                return;
            }
            let overflow = self.counts_to(0).filter(|counts| *counts <= passed);
            let turn = overflow.filter(|_| self.cr1 & OPM != 0 || self.awaits_update());
            let passed = turn.unwrap_or(passed);
            for (bit, value) in self.events() {
                if self.counts_to(value).is_some_and(|counts| counts <= passed) {
                    self.sr |= bit;
                }
            }
            self.seen += passed;
            if turn.is_some() {
                self.settle(now);
                self.load();
                // OPM and CEN are the bits 3 and 0.
                self.cr1 &= !(self.cr1 >> 3 & CEN);
            }
            self.plan();
        }
    }

    /// Whether the next update event changes the count.
    fn awaits_update(&self) -> bool {
        self.divider != self.prescaler || self.preloaded.is_some()
    }

    /// Loads what waits for an update event.
    fn load(&mut self) {
        self.divider = self.prescaler;
        self.reload = self.preloaded.take().unwrap_or(self.reload);
    }

    /// The waveform that a channel, 0 for the first, makes at its pin: PWM mode 1 or 2, or toggling.
    pub fn output(&self, channel: usize) -> Option<Pwm> {
        let mode = self.modes[channel / 2] >> (8 * (channel % 2) + 4) & 7;
        let enable = self.enables >> (4 * channel) & 3;
        let is_off = self.exists(BDTR) && self.bdtr & MOE_AOE == 0;
        if enable & 1 == 0 || is_off || self.cr1 & CEN == 0 {
            return None;
        }
        let all = u64::from(self.reload) + 1;
        let active = u64::from(self.compare[channel]).min(all);
        let (period, active) = match mode {
            6 => (all, active),
            7 => (all, all - active),
            3 => (2 * all, all),
            _ => return None,
        };
        let high = if enable & 2 == 0 { active } else { period - active };
        let (rate, count) = self.rate();
        let time = |counts: u64| Time::from_ps((u128::from(counts) * count / rate) as u64);
        Some(Pwm { period: time(period), high: time(high) })
    }

    fn exists(&self, offset: u32) -> bool {
        let channels = u32::from(self.kind.channels);
        match offset {
            CR1 | DIER | SR | EGR | CNT | PSC | ARR => true,
            CR2 => channels != 1,
            SMCR => channels > 1,
            CCMR1 | CCER => channels > 0,
            CCMR2 => channels > 2,
            CCR1..=CCR4 => (offset - CCR1) / 4 < channels,
            RCR | BDTR => self.kind.irqs.0 != self.kind.irqs.1,
            OR => self.has_capture(),
            _ => false,
        }
    }

    /// Generates events; an update event loads the prescaler and clears the counter.
    fn generate(&mut self, events: u32) {
        if events & UPDATE != 0 {
            self.load();
            self.origin = 0;
        }
        let silent = if self.cr1 & URS == 0 { 0 } else { UPDATE };
        self.sr |= events & !silent;
    }

    fn check(&self) -> Result<(), Problem> {
        if self.cr1 & CEN == 0 {
            return Ok(());
        }
        if self.origin > self.reload {
            return Err(Problem::Misuse("a timer's counter is above its auto-reload value"));
        }
        Ok(())
    }

    /// The number of timer clock periods per second, in millionths, and per count.
    fn rate(&self) -> (u128, u128) {
        (self.clock.rate(), SCALE * u128::from(self.divider + 1))
    }

    fn counts_until(&self, now: Time) -> u64 {
        if !self.counts() {
            return 0;
        }
        let (rate, count) = self.rate();
        (u128::from(now.saturating_sub(self.since).as_ps()) * rate / count) as u64
    }

    /// The counter after this number of counts since `since`.
    fn count_after(&self, counts: u64) -> u32 {
        ((u64::from(self.origin) + counts) % (u64::from(self.reload) + 1)) as u32
    }

    /// The flags of SR, and the counter value that sets each.
    fn events(&self) -> impl Iterator<Item = (u32, u32)> + use<> {
        let captures = usize::from(self.has_capture() && self.modes[0] & CC1S != 0);
        let channels = self.compare.into_iter().take(self.kind.channels.into()).enumerate();
        channels
            .skip(captures)
            .map(|(channel, value)| (UPDATE << (1 + channel), value))
            .chain([(UPDATE, 0)])
    }

    /// The number of counts from those in SR until the counter reaches `value`, at least one.
    fn counts_to(&self, value: u32) -> Option<u64> {
        let period = u64::from(self.reload) + 1;
        let ahead = u64::from(value) + period - u64::from(self.count_after(self.seen));
        (value <= self.reload).then_some(if ahead > period { ahead - period } else { ahead })
    }

    /// Makes the current count the origin, so that any setting may change.
    fn settle(&mut self, now: Time) {
        let (rate, count) = self.rate();
        let whole = (u128::from(self.seen) * count).div_ceil(rate);
        self.origin = self.count_after(self.seen);
        self.since = if !self.counts() { now } else { self.since + Time::from_ps(whole as u64) };
        self.seen = 0;
    }

    /// Determines the next interrupt.
    fn plan(&mut self) {
        let waits = |&(bit, _): &(u32, u32)| self.dier & !self.sr & bit != 0;
        let update = self.counts_to(0).filter(|_| self.dier != 0 && self.awaits_update());
        let events = self.events().filter(waits).filter_map(|(_, value)| self.counts_to(value));
        let next = events.chain(update).min();
        self.deadline = match next {
            Some(counts) if self.counts() => {
                let (rate, count) = self.rate();
                let ahead = (u128::from(self.seen + counts) * count).div_ceil(rate);
                Time::from_ps(self.since.as_ps().saturating_add(ahead as u64))
            }
            _ => Time::MAX,
        };
    }
}

impl Registers for Timer {
    fn reset(&mut self, _: Time) {
        *self = Self { clock: self.clock, ..Self::new(self.kind) };
    }

    fn read(&mut self, offset: u32, now: Time) -> Option<u32> {
        self.advance(now);
        if !self.exists(offset) {
            return None;
        }
        Some(match offset {
            CR1 => self.cr1,
            DIER => self.dier,
            SR => self.sr,
            CNT => self.count_after(self.seen),
            PSC => self.prescaler,
            ARR => self.preloaded.unwrap_or(self.reload),
            CCMR1 => self.modes[0],
            CCMR2 => self.modes[1],
            CCER => self.enables,
            BDTR => self.bdtr,
            CCR1..=CCR4 => {
                if offset == CCR1 && self.modes[0] & CC1S != 0 {
                    self.sr &= !CC1;
                }
                self.compare[(offset - CCR1) as usize / 4]
            }
            OR => self.option,
            _ => 0,
        })
    }

    /// Bits that are not modelled have no effect.
    fn write(&mut self, offset: u32, value: u32, now: Time) -> Result<(), Problem> {
        self.advance(now);
        if matches!(offset, CR1 | EGR | CNT | ARR) {
            self.settle(now);
        }
        if !self.exists(offset) {
            return Err(Problem::Unmodelled);
        }
        // A register of 16 bits ignores the upper half of the bus.
        let value = match offset {
            CNT | ARR | CCR1..=CCR4 => value & self.kind.max,
            _ => value & 0xFFFF,
        };
        let writable = match offset {
            CR1 => CEN | URS | OPM | ARPE,
            DIER | EGR => self.event_bits(),
            CCMR1 if self.has_capture() && value & CC1S == CAPTURES_TI1 => CC1S | IC1PSC,
            CCMR1 | CCMR2 => OUTPUT_MODES,
            CCER => ENABLES,
            OR => HSE_RTC,
            BDTR => MOE_AOE,
            PSC | SR | CNT | ARR | CCR1..=CCR4 => u32::MAX,
            _ => 0,
        };
        match offset {
            CR1 => self.cr1 = value & writable,
            DIER => self.dier = value & writable,
            // Cleared by writing 0.
            SR => self.sr &= value,
            EGR => self.generate(value & writable),
            CNT => self.origin = value,
            PSC => self.prescaler = value,
            ARR if self.cr1 & ARPE != 0 => self.preloaded = Some(value),
            ARR => (self.reload, self.preloaded) = (value, None),
            CCMR1 => self.modes[0] = value & writable,
            CCMR2 => self.modes[1] = value & writable,
            CCER => self.enables = value & writable,
            BDTR => self.bdtr = value & writable,
            CCR1..=CCR4 => self.compare[(offset - CCR1) as usize / 4] = value,
            OR => self.option = value & writable,
            _ => {}
        }
        if matches!(offset, CCMR1 | CCER | OR) {
            (self.captures_from, self.captures) = (now, 0);
        }
        self.plan();
        if value & !writable != 0 {
            return Err(Problem::Unmodelled);
        }
        self.check()
    }
}
