//! The SDO server as a part of the node, and the objects of the dictionary: the values that the node returns, and the
//! effects of writes.

use core::cmp::Ordering;

use lss_slave::Slave;

use super::{
    Node, Owed, Storing, Task, Tasks, communication::Communication, product::Product, program,
    settings_object,
};
use crate::{
    Frame, Instant, Program,
    application::Application,
    emergency::Emergency,
    lss::AddressPart,
    nmt::{self, ErrorBehaviour, slave::NmtSlave},
    object_dictionary::{self, Access, Entry, Object, TABLE},
    sdo::{self, Abort, Answer, BLOCK_SIZE, Content, Message, Objects},
};

const SAVE: u32 = u32::from_le_bytes(*b"save");
const LOAD: u32 = u32::from_le_bytes(*b"load");
/// The value of 1010h and 1011h: the device stores or restores on command.
const ON_COMMAND: u32 = 1;

impl<A: Application> Node<A> {
    pub(super) const fn serves_sdo(&self) -> bool {
        !self.slave.bit_rate().is_switching() && self.nmt.serves_sdo()
    }

    /// The objects, for accesses at `now`, and their server.
    pub(super) const fn objects(
        &mut self,
        now: Instant,
    ) -> (NodeObjects<'_, A>, &mut sdo::Server<A::SdoBuffer>) {
        let objects = NodeObjects {
            slave: &mut self.slave,
            nmt: &mut self.nmt,
            emergency: &mut self.emergency,
            storing: &mut self.storing,
            product: &mut self.product,
            now,
            effects: Tasks::NONE,
        };
        (objects, &mut self.sdo)
    }

    pub(super) fn sdo_request_cob_id(&self) -> Option<u16> {
        self.node_id().map(|id| sdo::REQUEST_COB_ID + u16::from(id.get()))
    }

    /// Accepts a request to the SDO server; returns the answer, unless anything is due before it.
    pub(super) fn handle_sdo(&mut self, request: Message, now: Instant) -> Option<Frame> {
        // A boot-up may precede the answer.
        self.slave.note_asked();
        if A::PROGRAM_DOWNLOAD
            && let Some(program) = self.product.application.program()
        {
            program.requested();
        }
        self.sdo.handle(request, self.serves_sdo(), now);
        // `poll` holds an answer back while a program has no room for what would follow.
        if A::PROGRAM_DOWNLOAD || self.is_due(now) {
            self.agenda.add(Tasks::of(&[Task::Sdo]));
            return None;
        }
        let answer = self.serve_sdo(now);
        if self.sdo.has_transfer() {
            self.agenda.add(Tasks::of(&[Task::Sdo]));
        }
        answer
    }

    pub(super) fn answer_sdo(&mut self, now: Instant) -> Option<Frame> {
        if !self.serves_sdo() {
            self.end_sdo_transfer();
            self.sdo.reset();
        }
        self.serve_sdo(now)
    }

    /// The next answer to the client, unless the boot-up precedes it.
    fn serve_sdo(&mut self, now: Instant) -> Option<Frame> {
        if self.nmt.is_boot_up_due() {
            return None;
        }
        if A::PROGRAM_DOWNLOAD && self.holds_answer(now) {
            return None;
        }
        let (mut objects, sdo) = self.objects(now);
        let answer = sdo.poll(&mut objects, now);
        let effects = objects.effects;
        self.agenda.add(effects);
        if effects.has(Task::Pdos) {
            self.note_values();
        }
        let answer = answer?;
        self.note_answer();
        self.sdo_frame(answer)
    }

    /// The frame of an answer to the SDO client.
    pub(super) fn sdo_frame(&self, answer: Message) -> Option<Frame> {
        let cob_id = sdo::RESPONSE_COB_ID + u16::from(self.node_id()?.get());
        Some(Frame::with_eight_bytes(cob_id, answer.to_bytes()))
    }

    /// Discards pending SDO requests and transfers.
    pub(super) fn end_sdo(&mut self) {
        self.end_sdo_transfer();
        self.sdo.reset();
        self.storing.forget_sdo();
    }

    /// Discards the current SDO transfer without an answer to the client.
    pub(super) fn end_sdo_transfer(&mut self) {
        if let Some(entry) = self.sdo.domain() {
            abort_domain(&mut self.product, entry);
        }
        self.sdo.end_transfer();
    }
}

/// The accesses of a client to the values of an application that may take more than 32 bytes, which are five segments.
struct Long {
    is_read: bool,
    is_written: bool,
}

impl Long {
    const fn of<A: Application>() -> Self {
        let is_any = size_of::<A::SdoBuffer>() > 32;
        let (mut long, mut objects) = (Self { is_read: is_any, is_written: is_any }, A::OBJECTS);
        while let [Entry { access, data_type, options, .. }, others @ ..] = objects {
            let is_constant_text = matches!(access, Access::Const) && data_type.size() == 0;
            let is_long = options.is_streamed() || is_constant_text;
            long.is_read |= is_long && !matches!(access, Access::WriteOnly);
            long.is_written |= is_long && !matches!(access, Access::Const | Access::ReadOnly);
            objects = others;
        }
        long
    }
}

/// The parts of the node that objects read and write, at one time.
pub(super) struct NodeObjects<'a, A: Application> {
    pub slave: &'a mut Slave,
    pub nmt: &'a mut NmtSlave,
    pub emergency: &'a mut Emergency,
    pub storing: &'a mut Storing,
    pub product: &'a mut Product<A>,
    pub now: Instant,
    /// The tasks that the accesses have made due.
    pub effects: Tasks,
}

impl<A: Application> Objects for NodeObjects<'_, A> {
    const TIMEOUT_MICROS: u32 = A::SDO_TIMEOUT_MS as u32 * 1000;
    const PROGRAM_DOWNLOAD: bool = A::PROGRAM_DOWNLOAD;
    const BLOCK_UPLOAD: bool = Long::of::<A>().is_read;
    const BLOCK_DOWNLOAD: bool = A::PROGRAM_DOWNLOAD || Long::of::<A>().is_written;

    fn find(&self, index: u16, sub_index: u8) -> Result<&'static Entry, Abort> {
        if A::PROGRAM_DOWNLOAD && program::contains(index) {
            return Ok(object_dictionary::find(program::ROWS, index, sub_index)?);
        }
        let of_communication = Communication::<A::Numbers>::table(index);
        let table = match A::OBJECTS.first() {
            _ if A::SETTINGS_BY_SDO && index == settings_object::INDEX => settings_object::ROWS,
            Some(first) if first.index <= index => A::OBJECTS,
            _ => of_communication.unwrap_or(TABLE),
        };
        Ok(object_dictionary::find(table, index, sub_index)?)
    }

    fn read(&mut self, entry: &Entry) -> Result<Content, Abort> {
        let node_id = self.slave.lss().active_node_id().map_or(0, |id| u32::from(id.get()));
        Ok(Content::Number(match entry.object {
            Object::Application(field) => {
                if A::PROGRAM_DOWNLOAD && program::contains(entry.index) {
                    let value = self.program()?.read(entry.index, entry.sub_index);
                    return Ok(Content::Number(value));
                }
                if !entry.options.is_streamed() {
                    self.product.application.before_read(entry.index, entry.sub_index);
                    self.effects.add(Self::VALUES);
                }
                return Ok(Content::OfApplication(field));
            }
            Object::DeviceName => return Ok(Content::Text(self.product.device.name)),
            Object::HardwareVersion => {
                return Ok(Content::Text(self.product.device.hardware_version));
            }
            Object::SoftwareVersion => {
                return Ok(Content::Text(self.product.device.software_version));
            }
            Object::DeviceType => A::DEVICE_TYPE,
            Object::ErrorRegister => self.emergency.error_register().into(),
            Object::NumberOfErrors => self.emergency.number_of_errors().into(),
            // CiA 301 names this code for object 1003h, and CANopenNode sends it, although the sub-index exists.
            Object::ErrorField(sub_index) => {
                self.emergency.error(sub_index).ok_or(Abort::NoData)?
            }
            Object::StoreParameters | Object::RestoreDefaultParameters => ON_COMMAND,
            Object::CobIdEmergency => {
                self.emergency.configuration.cob_id_value(self.slave.lss().active_node_id())
            }
            Object::InhibitTimeEmergency => self.emergency.configuration.inhibit_time.into(),
            Object::ProducerHeartbeatTime => self.nmt.heartbeat_ms().into(),
            Object::CommunicationErrorBehaviour => self.nmt.error_behaviour() as u32,
            Object::VerifyConfiguration(sub_index) => self.storing.verification.read(sub_index),
            Object::VendorId => self.slave.lss().address_part(AddressPart::VendorId),
            Object::ProductCode => self.slave.lss().address_part(AddressPart::ProductCode),
            Object::RevisionNumber => self.slave.lss().address_part(AddressPart::RevisionNumber),
            Object::SerialNumber => self.slave.lss().address_part(AddressPart::SerialNumber),
            Object::BusOffs => self.emergency.bus_offs().into(),
            Object::Overruns => self.emergency.overruns().into(),
            Object::TransmitErrorCounter => self.emergency.error_counters().transmit.into(),
            Object::ReceiveErrorCounter => self.emergency.error_counters().receive.into(),
            Object::HomeBitRate => {
                self.slave.bit_rate().home().map_or(0, |rate| rate.kbit_per_s().into())
            }
            Object::BitRateInUse => self.slave.bit_rate().in_use().kbit_per_s().into(),
            Object::Rescues => self.slave.bit_rate().rescues().into(),
            Object::RestartCause => self.emergency.restart().map_or(0, |r| r.cause as u32),
            Object::RestartAddress => self.emergency.restart().map_or(0, |r| r.address),
            Object::HighestSubIndex(highest) => highest.into(),
            Object::CobIdSdoRequest => u32::from(sdo::REQUEST_COB_ID) + node_id,
            Object::CobIdSdoResponse => u32::from(sdo::RESPONSE_COB_ID) + node_id,
            Object::PendingNodeId if A::SETTINGS_BY_SDO => {
                settings_object::node_id(self.slave.lss()).into()
            }
            Object::PendingBitRate if A::SETTINGS_BY_SDO => {
                settings_object::bit_rate(self.slave.lss()).into()
            }
            object if Communication::<A::Numbers>::IS_USED => {
                self.product.communication.read(object, self.slave.lss().active_node_id())?
            }
            _ => 0,
        }))
    }

    fn write(
        &mut self,
        entry: &Entry,
        bytes: &[u8],
        confirmation: Message,
    ) -> Result<Option<Message>, Abort> {
        if A::PROGRAM_DOWNLOAD && entry.index == program::CONTROL {
            let [value] = *bytes else { return Err(Abort::TooLong) };
            let state = self.nmt.state();
            let answer = self.program()?.control(value, state)?;
            return Ok(self.confirm(answer, entry, confirmation));
        }
        self.effects.add(tasks_of(entry.object));
        if let Object::Application(field) = entry.object {
            let value = A::parse(field, bytes)?;
            self.product.application.accept(&value)?;
            if entry.options.is_stored() && self.differs(field, bytes) {
                self.storing.verification.clear();
            }
            self.product.application.set(value);
            return Ok(Some(confirmation));
        }
        match bytes.len().cmp(&entry.data_type.size().into()) {
            Ordering::Greater => return Err(Abort::TooLong),
            Ordering::Less => return Err(Abort::TooShort),
            Ordering::Equal => {}
        }
        let number = bytes.iter().rev().fold(0, |number, byte| number << 8 | u32::from(*byte));
        match (entry.object, number) {
            (Object::StoreParameters, SAVE) | (Object::RestoreDefaultParameters, LOAD) => {
                if self.storing.sdo_request.is_some() {
                    return Err(Abort::Busy);
                }
                self.storing.sdo_request = Some(owed(entry, confirmation));
                Ok(None)
            }
            (Object::StoreParameters | Object::RestoreDefaultParameters, _) => {
                Err(Abort::NotStored)
            }
            (Object::VerifyConfiguration(sub_index), value) => {
                self.storing.verification.current.write(sub_index, value);
                Ok(Some(confirmation))
            }
            (object @ (Object::PendingNodeId | Object::PendingBitRate), value)
                if A::SETTINGS_BY_SDO =>
            {
                let is_operational = self.nmt.state() == nmt::State::Operational;
                if self.product.device.lss_lock && is_operational {
                    return Err(Abort::DeviceState);
                }
                let written = &mut self.storing.written;
                match object {
                    Object::PendingNodeId => {
                        written.set_node_id(self.slave.lss_mut(), value as u8)?
                    }
                    _ => written.set_bit_rate(self.slave.lss_mut(), value as u16)?,
                }
                Ok(Some(confirmation))
            }
            (object, value) => {
                let is_new = self.number(entry) != Some(value);
                self.storing.is_as_packed = false;
                self.write_number(object, value)?;
                if object != Object::NumberOfErrors && is_new {
                    self.storing.verification.clear();
                }
                Ok(Some(confirmation))
            }
        }
    }

    fn forget_store(&mut self) {
        self.storing.forget_sdo();
    }

    fn len(&mut self, entry: &Entry, field: u8) -> Result<u32, Abort> {
        match entry.options.is_streamed() {
            true => self.product.application.domain_len(entry.index, entry.sub_index),
            false => Ok(self.product.application.len(field) as u32),
        }
    }

    fn read_part(&self, entry: &Entry, field: u8, offset: u32, to: &mut [u8]) -> usize {
        match entry.options.is_streamed() {
            true => self.product.application.read_domain(entry.index, entry.sub_index, offset, to),
            false => self.product.application.read(field, offset as usize, to),
        }
    }

    fn begin_domain(&mut self, entry: &Entry, announced: Option<u32>) -> Result<(), Abort> {
        if A::PROGRAM_DOWNLOAD && entry.index == program::DATA {
            return Ok(());
        }
        self.effects.add(Self::VALUES);
        self.product.application.begin_domain(entry.index, entry.sub_index, announced)
    }

    fn write_domain(&mut self, entry: &Entry, offset: u32, bytes: &[u8]) -> Result<(), Abort> {
        if A::PROGRAM_DOWNLOAD && entry.index == program::DATA {
            return self.program()?.write(offset, bytes);
        }
        self.effects.add(Self::VALUES);
        self.product.application.write_domain(entry.index, entry.sub_index, offset, bytes)
    }

    fn end_domain(
        &mut self,
        entry: &Entry,
        len: u32,
        confirmation: Message,
    ) -> Result<Option<Message>, Abort> {
        if A::PROGRAM_DOWNLOAD && entry.index == program::DATA {
            let answer = self.program()?.end(len)?;
            return Ok(self.confirm(answer, entry, confirmation));
        }
        self.effects.add(Self::VALUES);
        self.product.application.end_domain(entry.index, entry.sub_index, len)?;
        Ok(Some(confirmation))
    }

    fn abort_domain(&mut self, entry: &Entry) {
        self.effects.add(Self::VALUES);
        abort_domain(self.product, entry);
    }

    fn grant(&mut self, entry: &Entry) -> u8 {
        let program = self.product.application.program().filter(|_| entry.index == program::DATA);
        program.map_or(BLOCK_SIZE, |program| program.grant())
    }

    fn granted(&mut self, entry: &Entry) -> u8 {
        let program = self.product.application.program().filter(|_| entry.index == program::DATA);
        program.map_or(BLOCK_SIZE, |program| program.granted())
    }
}

/// The tasks that a write of this object may make due.
const fn tasks_of(object: Object) -> Tasks {
    match object {
        Object::Application(_) => Tasks::of(&[Task::Pdos]),
        Object::StoreParameters | Object::RestoreDefaultParameters => Tasks::of(&[Task::Store]),
        Object::CobIdEmergency | Object::InhibitTimeEmergency | Object::ProducerHeartbeatTime => {
            Tasks::of(&[Task::Messages])
        }
        // Process data, SYNC and the heartbeat consumer.
        _ => Tasks::of(&[Task::Producers, Task::Pdos]),
    }
}

/// Discards what a client has written of a domain.
fn abort_domain<A: Application>(product: &mut Product<A>, entry: &Entry) {
    let Product { application, owed, .. } = product;
    if A::PROGRAM_DOWNLOAD && entry.index == program::DATA {
        owed.take_if(|owed| owed.index == program::DATA);
        application.program().into_iter().for_each(|program| program.abort());
        return;
    }
    application.abort_domain(entry.index, entry.sub_index);
}

/// A download whose answer follows later.
const fn owed(entry: &Entry, confirmation: Message) -> Owed {
    Owed { index: entry.index, sub_index: entry.sub_index, confirmation }
}

impl<A: Application> NodeObjects<'_, A> {
    /// The task for values of the application that may have changed.
    const VALUES: Tasks = tasks_of(Object::Application(0));

    fn program(&mut self) -> Result<&mut dyn Program, Abort> {
        self.product.application.program().ok_or(Abort::DeviceState)
    }

    /// The `confirmation` to send now; otherwise the node owes it for the program.
    fn confirm(&mut self, answer: Answer, entry: &Entry, confirmation: Message) -> Option<Message> {
        match answer {
            Answer::Now => Some(confirmation),
            Answer::Later => {
                self.product.owed = Some(owed(entry, confirmation));
                None
            }
        }
    }

    /// Whether the value of a field differs from these bytes.
    fn differs(&self, field: u8, bytes: &[u8]) -> bool {
        let is_other = |(at, byte): (usize, &u8)| {
            let mut now = [0];
            self.product.application.read(field, at, &mut now) == 0 || now != [*byte]
        };
        self.product.application.len(field) != bytes.len() || bytes.iter().enumerate().any(is_other)
    }

    /// The value of an object, if it is a number.
    pub(super) fn number(&mut self, entry: &Entry) -> Option<u32> {
        match self.read(entry) {
            Ok(Content::Number(number)) => Some(number),
            _ => None,
        }
    }

    fn write_number(&mut self, object: Object, number: u32) -> Result<(), Abort> {
        match object {
            Object::NumberOfErrors if number == 0 => self.emergency.clear_history(),
            Object::NumberOfErrors => return Err(Abort::InvalidValue),
            Object::CobIdEmergency => {
                let node = self.slave.lss().active_node_id();
                self.emergency.configuration.set_cob_id(number, node)?;
            }
            Object::InhibitTimeEmergency => {
                self.emergency.configuration.inhibit_time = number as u16;
            }
            Object::ProducerHeartbeatTime => self.nmt.set_heartbeat_ms(number as u16, self.now),
            Object::CommunicationErrorBehaviour => {
                let behaviour = ErrorBehaviour::new(number as u8).ok_or(Abort::InvalidValue)?;
                self.nmt.set_error_behaviour(behaviour);
            }
            object if Communication::<A::Numbers>::IS_USED => {
                let node = self.slave.lss().active_node_id();
                self.product.communication.write(object, number, node, A::OBJECTS)?;
            }
            _ => return Err(Abort::ReadOnly),
        }
        Ok(())
    }
}
