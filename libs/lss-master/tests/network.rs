//! The master with real slaves on a bus within the process.

use std::ops::Range;

use lss_master::{
    Assign, Configure, Error, Fastscan, Find, Identify, InquireAddress, InquireNodeId, Master,
    Member, Select, SelectAlone, SwitchBitRate, Timing,
};
use lss_slave::{
    BitRate, NodeId,
    lss::{Address, AddressPart, Request},
};
use testkit::{
    flash::BoardFlash,
    node_rig::{ADDRESS, NodeRig, defaults, device},
    random::{Random, every},
    slave_bus::{Faults, Habits, SlaveBus},
};

/// For slaves that answer within 100 us on a bus at 1 Mbit/s.
const FAST: Timing = Timing { answer: 20_000, store: 30_000, margin: 60, gap: 0 };

fn master() -> Master {
    Master::new(FAST)
}

fn address(serial_number: u32) -> Address {
    Address { serial_number, ..ADDRESS }
}

fn bus_of(rigs: impl IntoIterator<Item = NodeRig>) -> SlaveBus {
    let habits = Habits { answer_us: exactly(10), ..Habits::default() };
    let slaves = rigs.into_iter().map(|rig| (rig, habits.clone()));
    let mut bus = SlaveBus::new(slaves, Random::from_environment());
    bus.open(BitRate::Kbit1000, true);
    bus
}

fn bus(addresses: impl IntoIterator<Item = Address>) -> SlaveBus {
    bus_of(addresses.into_iter().map(NodeRig::with_address))
}

fn exactly(us: u64) -> Range<u64> {
    us..us + 1
}

/// Addresses that share parts and differ in single bits, and the extremes; at least three.
fn neighbours(random: &mut Random, count: usize) -> Vec<Address> {
    let mut all = vec![ADDRESS.into(), [0; 4], [u32::MAX; 4]];
    while all.len() < count {
        let mut parts = random.pick(&all);
        let part = random.within(0..4) as usize;
        parts[part] =
            if random.one_in(2) { parts[part] ^ 1 << random.within(0..32) } else { random.u32() };
        if !all.contains(&parts) {
            all.push(parts);
        }
    }
    all.into_iter().map(Address::from).collect()
}

/// A slave that does not support 800 kbit/s.
fn refusing() -> NodeRig {
    let rates = lss_slave::BitRates::possible(42_000_000);
    NodeRig::of(device(ADDRESS).with_bit_rates(rates).with_defaults(defaults(0xFF)))
}

fn node_id(id: u8) -> Configure {
    Configure::node_id(NodeId::new(id))
}

/// Gives all slaves without a node-ID one, from 1 on; returns their addresses in this order.
fn commission(bus: &mut SlaveBus, master: &mut Master, scan: &Fastscan) -> Vec<Address> {
    let mut found = Vec::new();
    let mut failures = 0;
    loop {
        let id = found.len() as u8 + 1;
        match bus.carry_out(master, Assign::scan(scan.clone(), node_id(id))) {
            Ok(Some(address)) => found.push(address),
            Ok(None) => return found,
            Err(error) => {
                println!("node-ID {id}: {error}");
                failures += 1;
                assert!(failures < 5, "{error}");
            }
        }
    }
}

/// Each slave has stored the node-ID that the master gave to its address, and runs with it.
fn assert_commissioned(bus: &mut SlaveBus, found: &[Address]) {
    assert_eq!(found.len(), bus.slaves.len());
    for slave in &bus.slaves {
        let rig = &slave.rig;
        let place = found.iter().position(|address| *address == rig.node.lss().address());
        let id = NodeId::new(place.expect("it is found") as u8 + 1);
        assert_eq!(rig.node.node_id(), id);
        assert_eq!(rig.stored().and_then(|stored| stored.node_id), id);
    }
    assert_eq!(bus.in_configuration(), 0);
}

#[test]
fn a_scan_takes_133_requests_and_ends_with_a_question_to_the_slave() {
    let mut bus = bus([ADDRESS]);
    assert_eq!(bus.carry_out(&mut master(), Fastscan::new()), Ok(Some(ADDRESS)));
    assert_eq!(bus.requests, 1 + 133 + 1, "04 00 before, 5D after it");
    assert_eq!(bus.in_configuration(), 1);
}

#[test]
fn a_scan_takes_little_more_than_the_bus_needs() {
    for (rate, limit_ms) in [(BitRate::Kbit1000, 40), (BitRate::Kbit125, 300)] {
        let board =
            NodeRig::new(ADDRESS, lss_slave::Settings::new(rate.into()), BoardFlash::blank(0), 0);
        let mut bus = bus_of([board]);
        bus.open(rate, true);
        let mut master = master();
        assert_eq!(bus.carry_out(&mut master, Fastscan::new()), Ok(Some(ADDRESS)));
        let before = bus.now();
        assert_eq!(bus.carry_out(&mut master, Fastscan::new()), Ok(Some(ADDRESS)));
        let ms = (bus.now() - before) / 1000;
        println!("{} kbit/s: {ms} ms", rate.kbit_per_s());
        assert!(ms <= limit_ms, "{ms} ms");
    }
}

#[test]
fn a_scan_of_a_network_without_blank_slaves_finds_none() {
    let mut bus = bus_of([NodeRig::with_node_id(5)]);
    assert_eq!(bus.carry_out(&mut master(), Fastscan::new()), Ok(None));
    assert_eq!(bus.requests, 1 + 3, "the beginning is repeated");
}

#[test]
fn two_slaves_that_differ_in_one_bit_get_different_node_ids() {
    for bit in 0..128 {
        let mut parts: [u32; 4] = ADDRESS.into();
        parts[bit / 32] ^= 1 << (bit % 32);
        let mut bus = bus([ADDRESS, parts.into()]);
        let found = commission(&mut bus, &mut master(), &Fastscan::new());
        assert_commissioned(&mut bus, &found);
    }
}

#[test]
fn each_of_127_slaves_gets_a_node_id() {
    let mut random = Random::from_environment();
    let mut bus = bus((0..127).map(|_| address(random.u32())));
    let scan = Fastscan::new()
        .with_known(AddressPart::VendorId, ADDRESS.vendor_id)
        .with_known(AddressPart::ProductCode, ADDRESS.product_code)
        .with_known(AddressPart::RevisionNumber, ADDRESS.revision_number);
    let found = commission(&mut bus, &mut master(), &scan);
    println!("{} ms", bus.now() / 1000);
    assert_commissioned(&mut bus, &found);
}

/// Gives all slaves without a node-ID one, each scan after the slave found last; returns their addresses.
fn commission_in_turn(bus: &mut SlaveBus, master: &mut Master) -> Vec<Address> {
    let mut found = Vec::new();
    let mut scan = Fastscan::new();
    loop {
        let id = found.len() as u8 + 1;
        match bus
            .carry_out(master, Assign::scan(scan.clone(), node_id(id)))
            .expect("a slave or none")
        {
            Some(address) => {
                found.push(address);
                scan = Fastscan::new().after_slave(address);
            }
            None => return found,
        }
    }
}

#[test]
fn a_scan_after_a_slave_of_the_same_product_takes_a_quarter_of_the_requests() {
    let mut bus = bus([address(0x0001_0000), address(0x8000_0000)]);
    let mut master = master();
    let configured = Assign::scan(Fastscan::new(), node_id(1));
    assert_eq!(bus.carry_out(&mut master, configured), Ok(Some(address(0x0001_0000))));
    let before = bus.requests;
    let next = Fastscan::new().after_slave(address(0x0001_0000));
    assert_eq!(bus.carry_out(&mut master, next), Ok(Some(address(0x8000_0000))));
    assert_eq!(bus.requests - before, 1 + 1 + 3 + 33 + 1);
    // A bit that the last one has set, behind the same bits, is not asked for.
    let mut bus = self::bus([address(0xFFFF_0001)]);
    let next = Fastscan::new().after_slave(address(0xFFFF_0000));
    assert_eq!(bus.carry_out(&mut master, next), Ok(Some(address(0xFFFF_0001))));
    assert_eq!(bus.requests, 1 + 1 + 3 + 17 + 1);
    // That holds for serial numbers of the same product only.
    let other = Address { vendor_id: !ADDRESS.vendor_id, ..address(0xFFFF_0001) };
    let mut bus = self::bus([other]);
    let next = Fastscan::new().after_slave(address(0xFFFF_0000));
    assert_eq!(bus.carry_out(&mut master, next), Ok(Some(other)));
    assert_eq!(bus.requests, 1 + 1 + 34 + 2 + 34);
}

#[test]
fn scans_in_turn_find_slaves_of_any_product_and_those_that_come_later() {
    let mut random = Random::from_environment();
    for _ in 0..10 {
        let mut bus = bus(neighbours(&mut random, 12));
        let found = commission_in_turn(&mut bus, &mut master());
        assert_commissioned(&mut bus, &found);
    }
    let mut bus = bus([address(2), address(0x1_0001)]);
    let mut master = master();
    let last = address(0x1_0001);
    for serial_number in [2, 0x1_0001] {
        let configure = node_id((serial_number & 1) as u8 + 1);
        let scan = Assign::address(address(serial_number), configure);
        assert!(bus.carry_out(&mut master, scan).is_ok());
    }
    let mut later = bus_of([NodeRig::with_address(address(1))]);
    bus.slaves.append(&mut later.slaves);
    let scan = Fastscan::new().after_slave(last);
    assert_eq!(bus.carry_out(&mut master, scan), Ok(Some(address(1))), "below the last one");
}

#[test]
fn the_margin_shrinks_to_what_the_slaves_need() {
    let mut random = Random::from_environment();
    let slaves = if every(2) == 1 { 127 } else { 40 };
    let mut bus = bus((0..slaves).map(|_| address(random.u32())));
    let mut master = Master::new(Timing::default());
    let found = commission_in_turn(&mut bus, &mut master);
    let ms = bus.now() / 1000;
    let slowest = master.slowest_answer().expect("they have answered");
    println!("{ms} ms, the slowest answer {slowest} us");
    assert_commissioned(&mut bus, &found);
    assert!(ms < 40 * slaves, "with a margin of 10 ms it is 170 ms a slave");
    assert!((200..1_000).contains(&slowest), "two frames, behind which some wait");
}

#[test]
fn a_slave_that_is_much_slower_than_the_others_is_found_among_them() {
    let mut random = Random::from_environment();
    for slow in 0..6 {
        let mut bus = bus((0..6).map(|_| address(random.u32())));
        bus.slaves[slow].habits.answer_us = exactly(60_000);
        let mut master = Master::new(Timing::default());
        let found = commission_in_turn(&mut bus, &mut master);
        assert_commissioned(&mut bus, &found);
    }
}

#[test]
fn known_parts_take_one_request_and_limit_the_scan_to_slaves_that_have_them() {
    let own: [u32; 4] = ADDRESS.into();
    for known in 0..16 {
        let mut scan = Fastscan::new();
        let mut requests = 1 + 133 + 1;
        for (number, part) in own.into_iter().zip((0..4).filter_map(AddressPart::new)) {
            if known >> part as u8 & 1 == 1 {
                scan = scan.with_known(part, number);
                requests -= 32;
            }
        }
        let mut bus = bus([ADDRESS, [u32::MAX; 4].into()]);
        assert_eq!(bus.carry_out(&mut master(), scan), Ok(Some(ADDRESS)));
        assert_eq!(bus.requests, requests);
    }
    let mut bus = bus([ADDRESS]);
    let other = Fastscan::new().with_known(AddressPart::ProductCode, 7);
    assert_eq!(bus.carry_out(&mut master(), other), Ok(None));
    assert_eq!(bus.in_configuration(), 0);
}

#[test]
fn different_answer_times_and_lost_late_and_doubled_frames_do_not_spoil_a_commissioning() {
    let mut random = Random::from_environment();
    for number in 0..25 {
        let mut bus = bus(neighbours(&mut random, 6));
        if number < 20 {
            bus.faults = Faults { lost: 150, doubled: 100, late: 200, late_us: 3_000 };
        } else {
            for slave in &mut bus.slaves {
                slave.habits.answer_us = exactly(random.within(50..8_000));
            }
        }
        let found = commission(&mut bus, &mut master(), &Fastscan::new());
        assert_commissioned(&mut bus, &found);
    }
}

#[test]
fn a_slave_that_loses_frames_back_to_back_is_selected_and_identified() {
    let mut bus = bus([ADDRESS, address(1)]);
    for slave in &mut bus.slaves {
        slave.habits.answer_us = exactly(800);
        slave.habits.loses_requests = true;
    }
    let mut master = Master::new(Timing { margin: 1_000, ..FAST });
    assert_eq!(bus.carry_out(&mut master, Select(ADDRESS)), Ok(()));
    let requests = bus.requests;
    assert_eq!(bus.carry_out(&mut master, Select(ADDRESS)), Ok(()));
    assert_eq!(bus.requests, requests + 5, "the master has learned the pause");
    assert_eq!(bus.carry_out(&mut master, InquireAddress::new()), Ok(ADDRESS));
    assert_eq!(bus.carry_out(&mut master, Identify::address(address(1))), Ok(true));
}

#[test]
fn the_answer_to_an_earlier_request_is_not_taken_for_that_to_the_present_one() {
    let mut bus = bus([ADDRESS]);
    let mut master = master();
    assert_eq!(bus.carry_out(&mut master, Select(ADDRESS)), Ok(()));
    bus.slaves[0].habits.answer_us = exactly(25_000);
    let [serial, product] =
        [AddressPart::SerialNumber, AddressPart::ProductCode].map(Request::Inquire);
    assert_eq!(bus.carry_out(&mut master, serial), Ok(()), "at the second attempt");
    assert_eq!(bus.carry_out(&mut master, product), Ok(()));
    assert_eq!(bus.carry_out(&mut master, InquireAddress::new()), Ok(ADDRESS));
}

#[test]
fn select_changes_the_slave_in_configuration_state() {
    let [first, second] = [address(1), address(2)];
    let mut bus = bus([first, second]);
    let mut master = master();
    for address in [first, second, first] {
        assert_eq!(bus.carry_out(&mut master, Select(address)), Ok(()));
        assert_eq!(bus.carry_out(&mut master, InquireAddress::new()), Ok(address));
        assert_eq!(bus.in_configuration(), 1);
    }
    let error = bus.carry_out(&mut master, Select(address(3)));
    assert_eq!(error, Err(Error::NoAnswer(Request::Select(AddressPart::SerialNumber, 3))));
    assert_eq!(bus.in_configuration(), 0);
}

#[test]
fn slaves_that_are_in_configuration_state_together_are_noticed() {
    let mut bus = bus([address(1), address(2)]);
    let mut master = master();
    bus.slaves[1].habits.answer_us = exactly(300);
    assert_eq!(bus.carry_out(&mut master, SelectAlone::new(address(1))), Ok(()));
    assert_eq!(bus.carry_out(&mut master, Request::SwitchToConfiguration), Ok(()));
    let who = Request::Inquire(AddressPart::SerialNumber);
    assert_eq!(bus.carry_out(&mut master, who), Err(Error::Inconsistent));
}

#[test]
fn a_slave_that_misses_the_switch_to_waiting_state_is_not_configured_with_the_next() {
    let selected = |is_alone: bool| {
        let mut bus = bus([address(1), address(2)]);
        // It misses what follows the switch to configuration state at once.
        bus.slaves[0].habits.answer_us = exactly(150);
        bus.slaves[0].habits.loses_requests = true;
        let mut master = master();
        assert_eq!(bus.carry_out(&mut master, Request::SwitchToConfiguration), Ok(()));
        let outcome = match is_alone {
            true => bus.carry_out(&mut master, SelectAlone::new(address(2))),
            false => bus.carry_out(&mut master, Select(address(2))),
        };
        assert_eq!(outcome, Ok(()));
        bus.in_configuration()
    };
    assert_eq!((selected(false), selected(true)), (2, 1));
}

#[test]
fn the_node_id_is_inquired_with_and_without_one() {
    for (rig, id) in
        [(NodeRig::with_node_id(0x40), NodeId::new(0x40)), (NodeRig::unconfigured(), None)]
    {
        let mut bus = bus_of([rig]);
        let mut master = master();
        assert_eq!(bus.carry_out(&mut master, Request::SwitchToConfiguration), Ok(()));
        assert_eq!(bus.carry_out(&mut master, InquireNodeId), Ok(id));
    }
}

#[test]
fn a_refusal_names_the_request_and_the_error_code() {
    let mut bus = bus([ADDRESS]);
    let mut master = master();
    assert_eq!(bus.carry_out(&mut master, Select(ADDRESS)), Ok(()));
    for request in [Request::ConfigureNodeId(0), Request::ConfigureBitTiming { table: 0, index: 5 }]
    {
        let refused = Error::Refused { request, code: 1, manufacturer_code: None };
        assert_eq!(bus.carry_out(&mut master, request), Err(refused));
    }
}

#[test]
fn a_known_slave_gets_its_node_id_and_bit_rate() {
    let mut bus = bus_of([NodeRig::with_node_id(5), NodeRig::with_address(address(1))]);
    let mut master = master();
    let configure = node_id(7).with_bit_rate(BitRate::Kbit250.into());
    assert_eq!(bus.carry_out(&mut master, Assign::address(ADDRESS, configure)), Ok(Some(ADDRESS)));
    let stored = bus.slaves[0].rig.stored().expect("it has stored");
    assert_eq!((stored.node_id, stored.bit_rate), (NodeId::new(7), BitRate::Kbit250.into()));
    assert_eq!(bus.slaves[0].rig.node.node_id(), NodeId::new(5), "until the next reset");
    assert_eq!(bus.slaves[1].rig.stored(), None);
    assert_eq!(bus.in_configuration(), 0);
}

#[test]
fn an_assignment_that_fails_leaves_no_slave_in_configuration_state() {
    let mut bus = bus_of([refusing()]);
    let configure = node_id(7).with_bit_rate(BitRate::Kbit800.into());
    let outcome = bus.carry_out(&mut master(), Assign::scan(Fastscan::new(), configure));
    assert!(matches!(outcome, Err(Error::Refused { code: 1, .. })), "{outcome:?}");
    assert_eq!(bus.in_configuration(), 0);
}

#[test]
fn identify_finds_each_slave_of_a_product_and_changes_none() {
    let mut random = Random::from_environment();
    for _ in 0..5 {
        let mut addresses: Vec<_> = (0..6).map(|_| address(random.u32())).collect();
        addresses.extend([address(0), address(u32::MAX)]);
        addresses[0].revision_number = random.u32();
        addresses[1] = Address { serial_number: addresses[0].serial_number ^ 1, ..addresses[1] };
        let mut bus = bus(addresses.clone());
        let mut master = master();
        let mut found = Vec::new();
        let mut rest = Identify::product(ADDRESS.vendor_id, ADDRESS.product_code);
        while let Some(address) =
            bus.carry_out(&mut master, Find::new(rest.clone())).expect("answers")
        {
            found.push(address);
            let Some(next) = address.serial_number.checked_add(1) else { break };
            rest.serial_numbers = next..=u32::MAX;
        }
        println!("{} ms, {} requests", bus.now() / 1000, bus.requests);
        addresses.sort_by_key(|address| address.serial_number);
        assert_eq!(found, addresses);
        assert_eq!(bus.in_configuration(), 0);
    }
}

#[test]
fn identify_bears_lost_and_late_frames() {
    let mut random = Random::from_environment();
    for _ in 0..20 {
        let serial_number = random.u32();
        let mut bus = bus([address(serial_number)]);
        bus.faults = Faults { lost: 200, late: 200, late_us: 2_000, doubled: 100 };
        let product = Identify::product(ADDRESS.vendor_id, ADDRESS.product_code);
        let find = Find::new(Identify { revision_numbers: 0..=0xFFFFF, ..product });
        assert_eq!(bus.carry_out(&mut master(), find), Ok(Some(address(serial_number))));
    }
}

fn members(addresses: &[Address]) -> Vec<Member> {
    addresses.iter().copied().map(Member::new).collect()
}

fn outcomes(members: &[Member]) -> Vec<Result<(), Error>> {
    members.iter().map(|member| member.outcome).collect()
}

fn switch(members: &mut [Member], to: BitRate) -> SwitchBitRate<'_> {
    SwitchBitRate::new(members, BitRate::Kbit1000, to, 50)
}

#[test]
fn all_slaves_follow_to_another_bit_rate_without_storing_it() {
    let addresses: Vec<_> = (0..32).map(address).collect();
    let mut bus = bus(addresses.clone());
    let mut master = master();
    let mut members = members(&addresses);
    assert_eq!(bus.carry_out(&mut master, switch(&mut members, BitRate::Kbit250)), Ok(()));
    assert_eq!(bus.rate, BitRate::Kbit250);
    for slave in &bus.slaves {
        assert_eq!(slave.rig.bit_rate(), BitRate::Kbit250);
        assert_eq!(slave.rig.stored(), None);
    }
    assert_eq!(bus.in_configuration(), 0);
}

#[test]
fn a_slave_that_does_not_support_the_bit_rate_keeps_the_network_as_it_is() {
    let addresses = [address(1), address(2), ADDRESS];
    let rigs = addresses[..2].iter().copied().map(NodeRig::with_address);
    let mut bus = bus_of(rigs.chain([refusing()]));
    let mut members = members(&addresses);
    let outcome = bus.carry_out(&mut master(), switch(&mut members, BitRate::Kbit800));
    let request = Request::ConfigureBitTiming { table: 0, index: 1 };
    let refused = Err(Error::Refused { request, code: 1, manufacturer_code: None });
    assert_eq!(outcome, refused);
    assert_eq!(outcomes(&members), [Ok(()), Ok(()), refused]);
    for slave in &bus.slaves {
        let lss = slave.rig.node.lss();
        assert_eq!(lss.pending_bit_rate(), BitRate::Kbit1000.into());
        assert_eq!(slave.rig.bit_rate(), BitRate::Kbit1000);
    }
    assert_eq!(bus.in_configuration(), 0);
}

#[test]
fn a_slave_that_does_not_come_along_is_named() {
    let addresses = [address(1), address(2), address(3)];
    let mut bus = bus(addresses);
    let mut master = master();
    let mut members = members(&addresses);
    // It is configured, and misses the rest.
    bus.slaves[1].habits.leaves_after = 19;
    let outcome = bus.carry_out(&mut master, switch(&mut members, BitRate::Kbit250));
    let lost = Err(Error::NoAnswer(Request::Select(AddressPart::SerialNumber, 2)));
    assert_eq!(outcome, lost);
    assert_eq!(outcomes(&members), [Ok(()), lost, Ok(())]);
}
