//! FDCAN1 of an STM32G431, as seen by a program (RM0440 chapter 44).

use emulator::{
    Time,
    can::{Frame, Id},
    chip::{Part, Problem},
    network::Short,
};

use crate::rig::{Rig, standard};

const AHB2ENR: u32 = 0x4002_104C;
const APB1ENR1: u32 = 0x4002_1058;
const CCIPR: u32 = 0x4002_1088;
const GPIOA: u32 = 0x4800_0000;

const TEST: u32 = 0x4000_6410;
const CCCR: u32 = 0x4000_6418;
const NBTP: u32 = 0x4000_641C;
const TSCC: u32 = 0x4000_6420;
const ECR: u32 = 0x4000_6440;
const PSR: u32 = 0x4000_6444;
const IR: u32 = 0x4000_6450;
const RXGFC: u32 = 0x4000_6480;
const XIDAM: u32 = 0x4000_6484;
const HPMS: u32 = 0x4000_6488;
const RXF0S: u32 = 0x4000_6490;
const RXF0A: u32 = 0x4000_6494;
const TXBC: u32 = 0x4000_64C0;
const TXFQS: u32 = 0x4000_64C4;
const TXBRP: u32 = 0x4000_64C8;
const TXBAR: u32 = 0x4000_64CC;
const TXBCR: u32 = 0x4000_64D0;
const TXBTO: u32 = 0x4000_64D4;
const TXBCF: u32 = 0x4000_64D8;
const TXBCIE: u32 = 0x4000_64E0;
const TXEFS: u32 = 0x4000_64E4;
const TXEFA: u32 = 0x4000_64E8;
const STANDARD_FILTERS: u32 = 0x4000_A400;
const EXTENDED_FILTERS: u32 = 0x4000_A470;
const FIFO_0: u32 = 0x4000_A4B0;
const EVENTS: u32 = 0x4000_A660;
const BUFFERS: u32 = 0x4000_A678;

const INIT: u32 = 1 << 0;
const CCE: u32 = 1 << 1;
const MON: u32 = 1 << 5;
const DAR: u32 = 1 << 6;
const QUEUE: u32 = 1 << 24;
const TCF: u32 = 1 << 8;
const TEFN: u32 = 1 << 10;
const EW: u32 = 1 << 18;
const BO: u32 = 1 << 19;

/// An event is wanted.
const EFC: u32 = 1 << 23;

impl Rig {
    /// FDCAN1 with clock and pins, on 16 MHz, in configuration.
    fn fdcan() -> Self {
        let mut rig = Self::new(Part::Stm32g431);
        rig.write_all(&[(AHB2ENR, 1), (APB1ENR1, 1 << 25), (CCIPR, 2 << 24)]);
        rig.write_all(&[(GPIOA + 0x24, 9 << 12 | 9 << 16), (GPIOA, 0xABFF_FFFF & !(5 << 22))]);
        rig.write(CCCR, INIT);
        rig.write(CCCR, INIT | CCE);
        rig.write(NBTP, 12 << 8 | 1);
        rig
    }

    /// The same on the bus, with registers that are written before and further bits of CCCR.
    fn on_the_bus(registers: &[(u32, u32)], cccr: u32) -> Self {
        let mut rig = Self::fdcan();
        rig.write_all(registers);
        rig.write_all(&[(CCCR, INIT | CCE | cccr), (CCCR, cccr)]);
        rig.run_us(20);
        rig
    }

    fn request(&mut self, buffer: u32, id: u32, control: u32) {
        let place = BUFFERS + 72 * buffer;
        self.write_all(&[(place, id), (place + 4, control), (TXBAR, 1 << buffer)]);
    }

    fn ids(&mut self) -> Vec<Id> {
        self.received().iter().map(|frame| frame.id).collect()
    }

    /// Sends a frame and returns the words of the element of FIFO 0 that gets it, if any does.
    fn accepted(&mut self, frame: Frame) -> Option<[u32; 3]> {
        self.send(frame);
        self.run_us(200);
        let status = self.read(RXF0S);
        let element = FIFO_0 + 72 * (status >> 8 & 3);
        self.write(RXF0A, status >> 8 & 3);
        (status & 0xF > 0).then(|| [0, 4, 8].map(|word| self.read(element + word)))
    }
}

/// 44.3.2: protected registers, and those that CCE resets.
#[test]
fn configuration_needs_init_and_then_cce_and_clears_requests() {
    let mut rig = Rig::fdcan();
    assert_eq!(rig.read(NBTP), 12 << 8 | 1);
    rig.write(CCCR, 0);
    rig.write(CCCR, CCE | MON);
    assert_eq!(rig.read(CCCR), 0, "not without INIT");
    assert_eq!(rig.problems(), []);
    rig.write_all(&[(NBTP, 5), (RXGFC, 1)]);
    assert_eq!((rig.read(NBTP), rig.read(RXGFC)), (12 << 8 | 1, 0));
    assert_eq!(rig.problems(), [Problem::Unmodelled; 2]);
    rig.request(1, 0x100 << 18, 0);
    rig.write(CCCR, INIT | CCE);
    assert_eq!((rig.read(CCCR), rig.read(TXBRP)), (INIT, 2), "CCE only after INIT");
    rig.write(CCCR, INIT | CCE);
    assert_eq!((rig.read(CCCR), rig.read(TXBRP)), (INIT | CCE, 0));
}

/// 44.3.4: transmit FIFO and transmit queue.
#[test]
fn a_fifo_sends_in_order_of_the_requests_and_a_queue_by_identifier() {
    for (mode, order, status) in
        [(0, [0x300, 0x100, 0x200], 1 << 21), (QUEUE, [0x100, 0x200, 0x300], 1 << 21)]
    {
        let mut rig = Rig::on_the_bus(&[(TXBC, mode)], 0);
        rig.send(standard(0, &[]));
        rig.run_us(2);
        for (buffer, id) in [0x300, 0x100, 0x200].into_iter().enumerate() {
            rig.request(buffer as u32, id << 18, 0);
        }
        assert_eq!(rig.read(TXFQS), status, "full");
        rig.run_us(400);
        assert_eq!(rig.ids(), order.map(Id::Standard));
    }
    let mut rig = Rig::on_the_bus(&[], 0);
    rig.request(0, 0x123 << 18, 0);
    assert_eq!(rig.read(TXFQS), 2 | 1 << 16, "two free, the next is buffer 1");
}

/// 44.4.32 and 44.4.34.
#[test]
fn a_cancelled_frame_is_not_sent_unless_it_is_under_way() {
    let mut rig = Rig::on_the_bus(&[(TXBCIE, 0b111), (TXBC, QUEUE)], 0);
    rig.request(0, 0x100 << 18, 0);
    rig.run_us(5);
    rig.request(1, 0x200 << 18, 0);
    rig.write(TXBCR, 0b011);
    assert_eq!((rig.read(TXBCF), rig.read(TXBRP), rig.read(TXBCR)), (2, 1, 1));
    assert_eq!(rig.read(IR) & TCF, TCF);
    rig.run_us(200);
    assert_eq!((rig.read(TXBCF), rig.read(TXBTO), rig.read(TXBCR)), (3, 1, 0));
    assert_eq!(rig.ids(), [Id::Standard(0x100)]);
}

/// 44.4.7, DAR.
#[test]
fn without_retransmission_a_failure_is_a_cancellation() {
    let mut rig = Rig::on_the_bus(&[], DAR);
    rig.adapter().close();
    rig.request(0, 0x100 << 18, 0);
    rig.run_us(200);
    assert_eq!((rig.read(TXBRP), rig.read(TXBTO), rig.read(TXBCF)), (0, 0, 1));
    assert_eq!(rig.read(ECR), 1 << 16 | 8, "one error is logged, TEC is 8");
}

/// 44.3.4: receive FIFOs; 44.4.21, F0OM.
#[test]
fn a_full_fifo_loses_the_newest_frame_or_overwrites_the_oldest() {
    for (overwrites, kept, flags) in [(0, [1, 2, 3], 0b111), (1 << 9, [2, 3, 4], 0b011)] {
        let mut rig = Rig::on_the_bus(&[(RXGFC, overwrites)], 0);
        for number in 1..=4 {
            rig.send(standard(number, &[number as u8]));
        }
        rig.run_us(500);
        assert_eq!(rig.read(IR), flags);
        let status = rig.read(RXF0S);
        assert_eq!((status & 0xF, status >> 24), (3, 1 | flags >> 2 << 1));
        for number in kept {
            let get = rig.read(RXF0S) >> 8 & 3;
            let element = FIFO_0 + 72 * get;
            let [id, control, data] = [0, 4, 8].map(|word| rig.read(element + word));
            assert_eq!((id, control, data & 0xFF), (number << 18, 1 << 31 | 1 << 16, number));
            rig.write(RXF0A, get);
        }
        assert_eq!(rig.read(RXF0S) & 0xF, 0);
    }
}

/// 44.3.3 and 44.4.21.
#[test]
fn the_first_filter_that_matches_decides_and_rxgfc_for_the_others() {
    let filters = [
        // Reject 105h, then 100h to 10Fh, 200h and 210h, all with the last digit 7, and nothing.
        (STANDARD_FILTERS, 2 << 30 | 3 << 27 | 0x105 << 16 | 0x7FF),
        (STANDARD_FILTERS + 4, 1 << 27 | 0x100 << 16 | 0x10F),
        (STANDARD_FILTERS + 8, 1 << 30 | 1 << 27 | 0x200 << 16 | 0x210),
        (STANDARD_FILTERS + 12, 2 << 30 | 5 << 27 | 0x007 << 16 | 0x00F),
        (STANDARD_FILTERS + 16, 3 << 30 | 1 << 27),
        // 12340h to 12345h after the mask, 777h.
        (EXTENDED_FILTERS, 1 << 29 | 0x12340),
        (EXTENDED_FILTERS + 4, 0x12345),
        (EXTENDED_FILTERS + 8, 1 << 29 | 0x777),
        (EXTENDED_FILTERS + 12, 2 << 30 | 0xFFF),
        (XIDAM, 0xF_FFFF),
    ];
    let mut rig = Rig::on_the_bus(&filters, 0);
    // Five and two filters; others are rejected, and so are extended remote frames.
    rig.write_all(&[(CCCR, INIT), (CCCR, INIT | CCE)]);
    rig.write_all(&[(RXGFC, 2 << 24 | 5 << 16 | 0b10 << 4 | 0b10 << 2 | 1), (CCCR, 0)]);
    rig.run_us(20);
    let extended = |id| Frame::data(Id::Extended(id), &[]);
    for (frame, filter) in [
        (standard(0x100, &[]), Some(1)),
        (standard(0x10F, &[]), Some(1)),
        (standard(0x110, &[]), None),
        (standard(0x105, &[]), None),
        (standard(0x210, &[]), Some(2)),
        (standard(0x211, &[]), None),
        (standard(0x347, &[]), Some(3)),
        (Frame::remote(Id::Standard(0x200), 2), Some(2)),
        (extended(0x12345), Some(0)),
        (extended(0xF01_2345), Some(0)),
        (extended(0x12346), None),
        (extended(0xABC_D777), Some(1)),
        (Frame::remote(Id::Extended(0x12345), 0), None),
    ] {
        let control = rig.accepted(frame).map(|[_, control, _]| control >> 24);
        assert_eq!(control, filter, "{frame}");
    }
    assert_eq!(rig.read(HPMS), 2 << 6 | 3 << 8 | rig.read(HPMS) & 0b11, "347h has priority");
    rig.write_all(&[(CCCR, INIT), (CCCR, INIT | CCE), (RXGFC, 0), (CCCR, 0)]);
    rig.run_us(20);
    let [id, control, _] = rig.accepted(extended(0x1234_5678)).expect("all are accepted");
    assert_eq!((id, control >> 24), (1 << 30 | 0x1234_5678, 1 << 7));
}

/// 44.3.4: transmit events.
#[test]
fn a_frame_that_asks_for_it_leaves_an_event() {
    let mut rig = Rig::on_the_bus(&[(TSCC, 1)], 0);
    rig.request(0, 0x100 << 18, 0);
    rig.run_us(100);
    assert_eq!(rig.read(TXEFS), 0);
    rig.request(1, 0x101 << 18, EFC | 0x5A << 24);
    rig.run_us(100);
    assert_eq!(rig.read(TXEFS), 1 | 1 << 16);
    assert_eq!(rig.read(IR) & TEFN, TEFN);
    let [id, event] = [EVENTS, EVENTS + 4].map(|word| rig.read(word));
    assert_eq!((id, event >> 22), (0x101 << 18, 0x5A << 2 | 1));
    assert!((120..125).contains(&(event & 0xFFFF)), "bit times since the start: {event:x}");
    rig.write(TXEFA, 0);
    assert_eq!(rig.read(TXEFS), 1 << 8 | 1 << 16);
}

/// 44.4.7, INIT, 44.4.11 and 44.4.12.
#[test]
fn bus_off_sets_init_and_ends_129_times_11_bits_after_the_program_clears_it() {
    let mut rig = Rig::on_the_bus(&[], 0);
    let now = rig.now;
    rig.buses[0].0.set_short(Some(Short::Recessive), now);
    rig.request(0, 0x123 << 18, 0);
    rig.run_us(20_000);
    assert_eq!(rig.read(CCCR), INIT);
    assert_eq!(rig.read(PSR) & 0xFF, 0xE0 | 5, "bus-off, warning, passive; the last error");
    assert_eq!((rig.read(IR) & (BO | EW), rig.read(TXBRP)), (BO | EW, 1));
    let now = rig.now;
    rig.buses[0].0.set_short(None, now);
    rig.write_all(&[(IR, u32::MAX), (CCCR, 0)]);
    rig.run_us(3 * 11);
    assert_eq!((rig.read(ECR) >> 8 & 0x7F, rig.read(PSR) & 7), (3, 5), "each sequence");
    assert_eq!(rig.read(PSR) & 7, 7, "none since");
    rig.run_us(126 * 11 - 1);
    assert_eq!((rig.read(PSR) & 0x80, rig.ids()), (0x80, vec![]));
    rig.run_us(2);
    assert_eq!((rig.read(PSR) & 0xE0, rig.read(ECR) & 0xFFFF), (0, 0));
    assert_eq!(rig.read(IR) & BO, BO);
    rig.run_us(100);
    assert_eq!(rig.ids(), [Id::Standard(0x123)], "the request stands");
}

/// 44.4.11, CEL, and 44.4.12, LEC.
#[test]
fn reads_of_psr_and_ecr_by_the_program_clear_what_they_show() {
    let mut rig = Rig::on_the_bus(&[], 0);
    rig.adapter().close();
    rig.request(0, 0x100 << 18, 0);
    rig.run_us(60);
    assert_eq!([rig.read(PSR) & 7, rig.read(PSR) & 7], [3, 7], "acknowledgement error");
    assert_eq!([rig.read(ECR) >> 16, rig.read(ECR) >> 16], [1, 0]);
    rig.adapter().open();
    rig.run_us(300);
    assert_eq!(rig.read(PSR) & 0x1F, 1 << 3, "idle after a good frame");
}

/// 44.4.4, RX.
#[test]
fn test_shows_the_level_of_the_receive_pin() {
    let mut rig = Rig::on_the_bus(&[], 0);
    assert_eq!(rig.read(TEST), 1 << 7);
    let now = rig.now;
    rig.buses[0].0.set_short(Some(Short::Dominant), now);
    rig.run_us(1);
    assert_eq!(rig.read(TEST), 0);
    rig.write(TEST, 1 << 7);
    assert_eq!(rig.problems(), []);
}

/// 44.4.4: it holds its reset value.
#[test]
fn a_write_to_test_is_ignored_while_cccr_test_is_0() {
    let mut rig = Rig::fdcan();
    rig.write(TEST, 1 << 4);
    assert_eq!((rig.read(TEST), rig.problems()), (1 << 7, vec![]));
    rig.write_all(&[(CCCR, INIT | CCE | 1 << 7), (TEST, 1 << 4)]);
    assert_eq!(rig.read(TEST), 1 << 7 | 1 << 4);
}

/// 44.3.2: bus monitoring mode, and loop back modes.
#[test]
fn a_monitor_receives_without_acknowledging_and_sends_only_to_itself() {
    let mut rig = Rig::on_the_bus(&[], MON);
    rig.request(0, 0x100 << 18, 0);
    assert_eq!(rig.read(TXBRP), 0);
    rig.send(standard(1, &[]));
    rig.run_us(200);
    assert_eq!((rig.adapter().unsent(), rig.read(RXF0S) & 0xF), (1, 0));
    // An error passive sender no longer destroys what nobody acknowledges.
    rig.run_us(1_000);
    assert_eq!((rig.adapter().unsent(), rig.read(RXF0S) & 0xF > 0), (1, true));

    let mut rig = Rig::fdcan();
    rig.write(CCCR, INIT | CCE | 1 << 7 | MON);
    rig.write_all(&[(TEST, 1 << 4), (CCCR, 1 << 7 | MON)]);
    rig.run_us(20);
    rig.request(0, 0x100 << 18, 0);
    rig.run_us(100);
    assert_eq!((rig.read(RXF0S) & 0xF, rig.received().len()), (1, 0));
}

#[test]
fn what_is_not_modelled_is_reported() {
    for (register, value) in [(CCCR, INIT | CCE | 1 << 8), (CCCR, INIT | CCE | 1 << 2)] {
        let mut rig = Rig::fdcan();
        rig.write(register, value);
        assert_eq!(rig.problems(), [Problem::Unmodelled], "CAN FD, restricted operation");
    }
    let mut rig = Rig::on_the_bus(&[], 0);
    rig.request(0, 0, 1 << 21);
    assert_eq!(rig.problems(), [Problem::Unmodelled], "an FD frame");
    let mut rig = Rig::new(Part::Stm32g431);
    rig.write_all(&[(APB1ENR1, 1 << 25), (CCCR, 0)]);
    assert_eq!(rig.findings().len(), 1, "no pins");
    rig.at(Time::from_us(1)).read(0x4000_A400 + 212 * 4);
    assert_eq!(rig.findings().len(), 2, "past the message RAM");
}
