// The board on which the program of the first page of `src/lib.rs` is tested, which includes this file. Its controller has
// one mailbox, whose frame leaves 5 ms later, and lets a frame of a higher priority take the place.

use lss_slave::lss::Request;

#[derive(Default)]
struct Simulated {
    micros: core::cell::Cell<u32>,
    /// The requests of the master, with their times in us.
    requests: VecDeque<(u32, Request)>,
    /// The frame, and the time at which it leaves.
    mailbox: Option<(Frame, u32)>,
    log: Vec<String>,
    stored: Option<Settings>,
}

impl Simulated {
    /// Lets what is due leave.
    fn pass(&mut self) {
        if let Some((frame, _)) = self.mailbox.take_if(|(_, at)| *at <= self.micros.get()) {
            self.log.push(format!("{frame:?}"));
        }
    }
}

impl Can for Simulated {
    type Frame = Frame;
    type Error = embedded_can::ErrorKind;

    fn transmit(&mut self, frame: &Frame) -> nb::Result<Option<Frame>, Self::Error> {
        self.pass();
        if self.mailbox.is_some_and(|(pending, _)| pending.cob_id() <= frame.cob_id()) {
            return Err(nb::Error::WouldBlock);
        }
        let replaced = self.mailbox.replace((*frame, self.micros.get() + 5_000));
        Ok(replaced.map(|(frame, _)| frame))
    }

    fn receive(&mut self) -> nb::Result<Frame, Self::Error> {
        self.pass();
        let request = self.requests.front().filter(|(at, _)| *at <= self.micros.get());
        let frame = request.map(|(_, request)| request.to_frame()).ok_or(nb::Error::WouldBlock)?;
        self.requests.pop_front();
        Ok(frame)
    }
}

impl Board for Simulated {
    fn now(&self) -> Instant {
        self.micros.set(self.micros.get() + 500);
        Instant::from_micros(self.micros.get())
    }

    fn load(&mut self) -> Option<Settings> {
        self.stored
    }

    fn store(&mut self, settings: Settings) -> Result<(), StoreError> {
        self.stored = Some(settings);
        Ok(())
    }

    fn run_at(&mut self, rate: BitRate, is_silent: bool) {
        self.log.push(format!("{rate}, silent: {is_silent}"));
    }

    fn drop_frames(&mut self) {
        self.mailbox = None;
        self.log.push("drops its frames".into());
    }
}

fn test() {
    let table = Request::ConfigureBitTiming { table: 0, index: BitRate::Kbit500.index() };
    let requests = [
        // A master that does not wait for an answer: most requests find the mailbox full.
        (0, Request::SwitchToConfiguration),
        (0, Request::ConfigureNodeId(5)),
        (0, table),
        (0, Request::StoreConfiguration),
        (0, Request::SwitchToWaiting),
        (100_000, Request::SwitchToConfiguration),
        (100_000, Request::ActivateBitTiming(10)),
    ];
    let mut board = Simulated { requests: requests.into(), ..Simulated::default() };
    run(&mut board);
    let zeros = "00, 00, 00, 00, 00, 00, 00";
    let expected = [
        "125 kbit/s, silent: false".into(),
        format!("7E4: [11, {zeros}]"),
        format!("7E4: [13, {zeros}]"),
        // The boot-up takes the place of the answer before, which leaves behind it.
        "705: [00]".into(),
        format!("7E4: [17, {zeros}]"),
        "drops its frames".into(),
        "500 kbit/s, silent: false".into(),
    ];
    assert_eq!(board.log, expected);
    board.log.clear();
    board.micros.set(0);
    run(&mut board);
    assert_eq!(board.log, ["500 kbit/s, silent: false", "705: [00]"], "both settings are stored");
}
