//! What an application declares beside the values of its objects: private state, functions for a DOMAIN and a long
//! text, and its own defaults for 1016h and 1029h.

use canopen_node::{
    Application, Node,
    application::{Dictionary, Domain, Event, LongText},
    nmt::{self, ErrorBehaviour},
    object_dictionary::DefaultValue,
    objects,
    sdo::Abort,
};
use testkit::{
    flash::BoardFlash,
    frames::{SILENCE, of_node},
    node_rig::{ADDRESS, NodeRig, defaults, device},
    sdo::Client,
};

objects! {
    /// A valve that keeps a profile and a manual, and counts what it hears of node 5.
    struct Valve, values ValveValue;

    /// The bytes of the profile, which a client replaces.
    private profile: Vec<u8> = Vec::new();
    private copy: Vec<u8> = Vec::new();
    private lost: u8 = 0;
    private back: u8 = 0;

    0x2100 {
        0 "Opening in percent" opening: u8 = 10, rw in 0..=100;
    }
    0x2101 {
        0 "Profile" profile_domain: Domain = Domain, rw with read_profile and write_profile;
    }
    0x2102 {
        0 "Manual" manual: LongText = LongText, ro with read_manual;
    }
}

impl Valve {
    fn read_profile(&self) -> &[u8] {
        &self.copy
    }

    fn write_profile(&mut self, offset: usize, bytes: &[u8]) -> Result<(), Abort> {
        self.profile.truncate(offset);
        if offset + bytes.len() > 3_000 {
            return Err(Abort::TooLong);
        }
        self.profile.extend(bytes);
        Ok(())
    }

    fn read_manual(&self) -> &[u8] {
        MANUAL
    }
}

impl Application for Valve {
    fn begin_domain(&mut self, _: u16, _: u8, announced: Option<u32>) -> Result<(), Abort> {
        if announced.is_some_and(|len| len > 3_000) { Err(Abort::TooLong) } else { Ok(()) }
    }

    fn domain_len(&mut self, index: u16, sub_index: u8) -> Result<u32, Abort> {
        self.copy = self.profile.clone();
        self.domain(index, sub_index).map(|content| content.len() as u32).ok_or(Abort::NoData)
    }

    const PRODUCERS: usize = 2;
    const WATCHED: &'static [(u8, u16)] = &[(5, 100)];
    const ERROR_BEHAVIOUR: ErrorBehaviour = ErrorBehaviour::EnterStopped;

    fn handle(&mut self, event: Event) {
        match event {
            Event::HeartbeatLost(_) => self.lost += 1,
            Event::HeartbeatBack(_) => self.back += 1,
            _ => {}
        }
    }
}

const MANUAL: &[u8] = &[b'm'; 1_000];

fn valve() -> NodeRig<Valve> {
    NodeRig::running(Valve::new())
}

/// What the application has heard of node 5: lost, back.
fn heard(board: &NodeRig<Valve>) -> (u8, u8) {
    let valve = board.node.application();
    (valve.lost, valve.back)
}

#[test]
fn a_domain_is_read_and_written_by_the_two_functions_of_its_declaration() {
    let mut board = valve();
    assert_eq!(board.upload(0x2101, 0), Ok(vec![]));
    let profile: Vec<u8> = (0..2_000).map(|at| at as u8).collect();
    assert_eq!(board.download(0x2101, 0, &profile), Ok(()));
    assert_eq!(board.node.application().profile, profile);
    assert_eq!(board.upload(0x2101, 0), Ok(profile));
    assert_eq!(board.download(0x2101, 0, &[0; 3_001]), Err(0x0607_0012));
    assert_eq!(board.download(0x2101, 0, &[7]), Ok(()), "it begins anew");
    assert_eq!(board.upload(0x2101, 0), Ok(vec![7]));
}

#[test]
fn a_long_text_is_read_by_its_function_and_is_a_visible_string() {
    let mut board = valve();
    assert_eq!(board.upload(0x2102, 0), Ok(MANUAL.to_vec()));
    assert!(board.download(0x2102, 0, b"new").is_err(), "it is ro");
    let (entry, _) =
        Node::<Valve>::entries(&device(ADDRESS)).find(|(entry, _)| entry.index == 0x2102).unwrap();
    assert_eq!(entry.data_type as u8, 0x09);
}

#[test]
fn an_event_tells_that_a_heartbeat_is_back_once() {
    let mut board = valve();
    let node_5 = of_node("705: 05");
    board.receive(&node_5);
    board.pass_ms(100);
    assert_eq!(heard(&board), (1, 0));
    board.receive(&node_5);
    board.receive(&node_5);
    assert_eq!(heard(&board), (1, 1));
    board.pass_ms(100);
    board.receive(&of_node("705: 00"));
    assert_eq!(heard(&board), (2, 2), "a boot-up is a heartbeat, too");
}

#[test]
fn a_new_device_watches_the_nodes_that_its_application_declares() {
    let mut board = valve();
    assert_eq!((board.number(0x1016, 1), board.number(0x1016, 2)), (0x0005_0064, 0));
    board.nmt("01 00");
    board.receive(&of_node("705: 05"));
    board.pass_ms(100);
    assert_eq!(board.nmt("04 00"), SILENCE);
    assert_eq!(board.node.nmt_state(), canopen_node::nmt::State::Stopped, "that of 1029h");
}

#[test]
fn what_a_client_stores_replaces_the_declared_1016h_and_1029h_also_by_0() {
    let mut board = valve();
    assert_eq!(board.number(0x1029, 1), 2);
    board.download(0x1016, 1, &[0; 4]).unwrap();
    board.download(0x1029, 1, &[0]).unwrap();
    board.nmt("82 00");
    assert_eq!((board.number(0x1016, 1), board.number(0x1029, 1)), (0x0005_0064, 2), "not stored");
    board.download(0x1016, 1, &[0; 4]).unwrap();
    board.download(0x1029, 1, &[0]).unwrap();
    board.save(1).unwrap();
    board.power_cycle();
    assert_eq!((board.number(0x1016, 1), board.number(0x1029, 1)), (0, 0));
    board.load(1).unwrap();
    board.power_cycle();
    assert_eq!((board.number(0x1016, 1), board.number(0x1029, 1)), (0x0005_0064, 2));
}

#[test]
fn the_data_sheet_has_the_declared_1016h_and_1029h() {
    let defaults: Vec<_> = Node::<Valve>::entries(&device(ADDRESS))
        .filter(|(entry, _)| matches!((entry.index, entry.sub_index), (0x1016 | 0x1029, 1)))
        .map(|(_, description)| description.default)
        .collect();
    assert_eq!(defaults, [DefaultValue::Number(2), DefaultValue::Number(0x0005_0064)]);
}

#[test]
fn an_application_may_hold_what_cannot_be_copied_and_begins_with_its_start_value() {
    let valve = Valve::new();
    assert_eq!((valve.profile.len(), valve.lost, valve.opening), (0, 0, 10));
}

objects! {
    /// An application without objects, that hears and reports.
    struct Listener, values ListenerValue;

    private events: Vec<Event> = Vec::new();
}

impl Application for Listener {
    fn handle(&mut self, event: Event) {
        self.events.push(event);
    }
}

#[test]
fn an_application_without_objects_gets_events_and_reports_errors() {
    let device = device(ADDRESS).with_defaults(defaults(5));
    let mut board = NodeRig::with_application(device, BoardFlash::blank(0), 0, Listener::new());
    assert_eq!(board.nmt("01 05"), SILENCE);
    let events = &board.node.application().events;
    assert!(events.contains(&Event::Nmt(nmt::State::Operational)), "{events:?}");
    assert!(board.node.report(0x5001, 0, [0; 5]));
    assert_eq!(board.pass_ms(0), ["085: 01 50 01 00 00 00 00 00"]);
    board.node.end_report(0x5001);
    assert_eq!(board.pass_ms(0), ["085: 00 00 00 00 00 00 00 00"]);
}

#[test]
fn a_domain_that_is_announced_too_long_keeps_its_content() {
    let mut board = NodeRig::running(Valve::new());
    assert_eq!(board.download(0x2101, 0, &[1; 200]), Ok(()));
    let too_long = Err(0x0607_0012);
    for _ in 0..2 {
        assert_eq!(board.download(0x2101, 0, &[2; 3_001]), too_long);
        assert_eq!(board.block_download(0x2101, 0, &[2; 3_001]), too_long);
        assert_eq!(board.node.application().profile, [1; 200]);
    }
}

#[test]
fn a_domain_that_changes_within_an_upload_is_read_as_it_was_at_the_beginning() {
    let mut board = NodeRig::running(Valve::new());
    assert_eq!(board.download(0x2101, 0, &[1; 200]), Ok(()));
    assert_eq!(board.sdo("40 01 21 00").0[0].data()[4], 200);
    board.node.application_mut().profile = vec![2; 200];
    for toggle in [0x60, 0x70] {
        assert_eq!(board.sdo(&format!("{toggle:02X}")).0[0].data()[1..], [1; 7]);
    }
}
