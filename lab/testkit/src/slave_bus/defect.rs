//! What a slave does that it must not.

use canopen_node::{
    Application, Frame, NodeId,
    lss::{REQUEST_COB_ID, RESPONSE_COB_ID},
    nmt,
};

use super::{Happening, Slave, SlaveBus, Source};

/// What a slave does that it must not.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Defect {
    /// It refuses the LSS requests that begin with these bytes.
    Refuses(&'static [u8]),
    /// It stores once, and has this defect from then on.
    StoresOnce(&'static Defect),
    /// It stores, and says that it cannot.
    DeniesItsStore,
    /// It has no power from store configuration on.
    DiesAtStore,
    /// It says that it takes a node-ID, and does not.
    Disobeys,
    /// It says that it has stored, and has not.
    Forgets,
    /// It ignores NMT commands.
    IgnoresResets,
    /// It loses a node-ID when it hears a Fastscan.
    LosesItsNodeId,
    /// Another slave is in its place after a reset: that with this number.
    IsReplacedAtReset(usize),
    /// Another slave comes to the bus at its reset: that with this number.
    IsJoinedAtReset(usize),
    /// Its first boot-up messages are lost.
    LosesBootUps(usize),
    /// Its first answers to SDO and to identify non-configured remote slave are lost.
    LosesAnswers(usize),
    /// Texts of the object 2101h:3 have a zero behind them.
    PadsTexts,
    /// It does not know its own serial number when it is selected.
    IgnoresItsSelection,
    /// It tells another serial number by LSS.
    TellsAnotherSerialNumber,
    /// It refuses to tell its serial number by SDO.
    HidesItsSerialNumber,
    /// It says that it produces SYNC with the COB-ID 80h.
    ProducesSync,
}

impl Defect {
    /// What becomes of a frame that the slave sends.
    pub(super) fn alters(&mut self, frame: Frame) -> Option<Frame> {
        match (self, frame.cob_id(), frame.data()) {
            (Self::LosesBootUps(left @ 1..), 0x701..=0x77F, [0])
            | (Self::LosesAnswers(left @ 1..), 0x581..=0x5FF, _)
            | (Self::LosesAnswers(left @ 1..), RESPONSE_COB_ID, [0x50, ..]) => {
                *left -= 1;
                None
            }
            (Self::PadsTexts, cob_id, &[0x47, 0x01, 0x21, 3, a, b, c, d]) => {
                Frame::new(cob_id, &[0x43, 0x01, 0x21, 3, a, b, c, d])
            }
            (Self::TellsAnotherSerialNumber, RESPONSE_COB_ID, &[0x5D, a, b, c, d, ..]) => {
                Frame::new(RESPONSE_COB_ID, &[0x5D, !a, b, c, d, 0, 0, 0])
            }
            (Self::HidesItsSerialNumber, cob_id, [0x43, 0x18, 0x10, 4, ..]) => {
                Frame::new(cob_id, &[0x80, 0x18, 0x10, 4, 0x11, 0, 9, 6])
            }
            (Self::ProducesSync, cob_id, [0x43, 5, 0x10, 0, 0x80, 0, 0, 0]) => {
                Frame::new(cob_id, &[0x43, 5, 0x10, 0, 0x80, 0, 0, 0x40])
            }
            _ => Some(frame),
        }
    }
}

impl<A: Application + Clone> SlaveBus<A> {
    /// Lets a slave with a defect do something else with a frame; false if it does what it must.
    pub(super) fn misbehaves(&mut self, number: usize, frame: &Frame) -> bool {
        let now = self.now;
        let Slave { rig, defect, .. } = &mut self.slaves[number];
        let (Some(fault), &[specifier, ..]) = (*defect, frame.data()) else { return false };
        let id = rig.node.node_id().map(NodeId::get);
        match (frame.cob_id(), fault) {
            (nmt::COMMAND_COB_ID, Defect::IgnoresResets) => return true,
            (REQUEST_COB_ID, Defect::IgnoresItsSelection) if specifier == 0x43 => return true,
            (
                nmt::COMMAND_COB_ID,
                Defect::IsReplacedAtReset(other) | Defect::IsJoinedAtReset(other),
            ) if id.is_some_and(|id| frame.data() == [0x81, id]) => {
                *defect = None;
                let is_replaced = matches!(fault, Defect::IsReplacedAtReset(_));
                if is_replaced {
                    self.happen(number, Happening::PowerOff);
                }
                // Behind this frame.
                self.plan(now, other, Happening::PowerOn);
                return is_replaced;
            }
            (REQUEST_COB_ID, _) => {}
            _ => return false,
        }
        if (fault, specifier) == (Defect::LosesItsNodeId, 0x51) && id.is_some() {
            self.beside_bus(number, |rig| {
                rig.configure("11 FF, 17");
                rig.finish_store();
                rig.power_cycle();
            });
            return false;
        }
        if !self.beside_bus(number, |rig| rig.is_in_configuration_state()) {
            return false;
        }
        let code = match (fault, specifier) {
            (Defect::Refuses(start), _) if frame.data().starts_with(start) => 1,
            (Defect::DeniesItsStore, 0x17) => {
                self.beside_bus(number, |rig| {
                    rig.receive(frame);
                    rig.finish_store();
                });
                2
            }
            (Defect::StoresOnce(later), 0x17) => {
                self.slaves[number].defect = Some(*later);
                return false;
            }
            (Defect::DiesAtStore, 0x17) => {
                self.happen(number, Happening::PowerOff);
                return true;
            }
            (Defect::Disobeys, 0x11) | (Defect::Forgets, 0x17) => 0,
            _ => return false,
        };
        let answer = Frame::new(RESPONSE_COB_ID, &[specifier, code, 0, 0, 0, 0, 0, 0]);
        answer.into_iter().for_each(|answer| self.enqueue(now, Source::Slave(number), answer));
        true
    }
}
