//! The release image on a failing bus: its emergencies (CiA 301) and its NMT state.

use crate::rig::*;

const ERROR_PASSIVE: &str = "0C0: 20 81 11 00 00 00 00 00";
const NO_ERROR: &str = "0C0: 00 00 00 00 00 00 00 00";

fn node_40() -> ImageRig {
    rig_with(settings(0x40, BitRate::Kbit500).with_heartbeat_ms(100))
}

/// Leaves the board alone on the bus for `span`; returns the frames that it sends in the two seconds after.
fn alone_for(rig: &mut ImageRig, span: Time) -> Vec<String> {
    rig.network.adapter_mut(rig.master).close();
    rig.network.run_for(span);
    rig.network.adapter_mut(rig.master).open();
    rig.collect(Time::from_s(2)).texts()
}

fn emergencies(texts: &[String]) -> Vec<&str> {
    texts.iter().map(String::as_str).filter(|text| text.starts_with("0C0")).collect()
}

#[test]
fn a_board_that_was_left_alone_reports_error_passive_and_its_end_once() {
    let mut rig = node_40();
    rig.collect(Time::from_ms(50));
    for span in [Time::from_ms(300), Time::from_s(5)] {
        let sent = alone_for(&mut rig, span);
        assert_eq!(emergencies(&sent), [ERROR_PASSIVE, NO_ERROR], "{sent:?}");
    }
}

#[test]
fn a_board_that_boots_alone_sends_its_boot_up_before_it_reports_that() {
    let mut rig = node_40();
    rig.collect(Time::from_ms(50));
    rig.network.power_off(0);
    rig.network.adapter_mut(rig.master).close();
    rig.network.run_for(Time::from_ms(10));
    rig.power_on(0);
    let sent = alone_for(&mut rig, Time::from_s(3));
    assert_eq!(sent[0], "740: 00", "{sent:?}");
    assert_eq!(sent.iter().filter(|text| *text == "740: 00").count(), 1);
    assert_eq!(emergencies(&sent), [ERROR_PASSIVE, NO_ERROR], "{sent:?}");
}

#[test]
fn bus_off_has_the_effect_on_the_nmt_state_that_1029h_demands() {
    for (behaviour, command, after) in [
        (0, "01 00", "740: 7F"),
        (1, "01 00", "740: 05"),
        (2, "01 00", "740: 04"),
        (2, "80 00", "740: 04"),
    ] {
        let mut rig = node_40();
        rig.transmit(on_the_wire(&sdo::request(0x40, &format!("2F 29 10 01 {behaviour:02X}"))));
        rig.transmit_command(command);
        let from = rig.network.now();
        rig.short_circuit(Short::Recessive, Time::from_s(1));
        assert!(rig.did(0, from).any(|event| event.what == What::BusOff));
        let sent = rig.collect(Time::from_s(4)).texts();
        let heartbeat = sent.iter().rfind(|text| text.starts_with("740")).expect("a heartbeat");
        assert_eq!(heartbeat, after, "behaviour {behaviour} after {command}");
        if behaviour < 2 {
            rig.transmit(on_the_wire(&sdo::request(0x40, "40 03 10 01")));
            let latest = rig.collect(Time::from_ms(5)).texts();
            assert!(latest.contains(&"5C0: 43 03 10 01 40 81 00 00".into()), "{latest:?}");
        }
    }
}
