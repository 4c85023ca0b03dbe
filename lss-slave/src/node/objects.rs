//! The objects of the dictionary: the values that the node returns, and the effects of writes.

use super::{
    BitRateControl, Device, NmtSlave,
    storing::{Busy, Download, Storing},
};
use crate::{
    Instant,
    application::Application,
    emergency::{self, Emergency, Reports},
    lss::{self, AddressPart},
    nmt::ErrorBehaviour,
    object_dictionary::{self, Entry, Object, PARAMETERS, TABLE},
    process_data::ProcessData,
    sdo::{Abort, Objects, Value, Written},
};

const SAVE: u32 = u32::from_le_bytes(*b"save");
const LOAD: u32 = u32::from_le_bytes(*b"load");
/// The value of 1010h and 1011h: the device stores or restores on command.
const ON_COMMAND: u32 = 1;
/// 1000h: no device profile.
const DEVICE_TYPE: u32 = 0;

/// The parts of the node that objects read and write, at one time.
pub(super) struct Parts<'a, A, const TPDOS: usize, const RPDOS: usize, const PRODUCERS: usize> {
    pub device: &'a Device,
    pub lss: &'a lss::Slave,
    pub bit_rate: &'a BitRateControl,
    pub nmt: &'a mut NmtSlave,
    pub emergency: &'a mut Emergency,
    /// `None` if there are none in this node.
    pub reports: Option<&'a Reports>,
    pub storing: &'a mut Storing,
    pub process_data: &'a mut ProcessData<TPDOS, RPDOS, PRODUCERS>,
    pub application: &'a mut A,
    pub now: Instant,
}

impl<A: Application, const TPDOS: usize, const RPDOS: usize, const PRODUCERS: usize> Objects
    for Parts<'_, A, TPDOS, RPDOS, PRODUCERS>
{
    fn find(&self, index: u16, sub_index: u8) -> Result<&'static Entry, Abort> {
        let is_of_application = A::OBJECTS.first().is_some_and(|first| first.index <= index);
        let is_of_parameters = !A::OBJECTS.is_empty() && matches!(index, 0x1010 | 0x1011);
        let of_process_data = ProcessData::<TPDOS, RPDOS, PRODUCERS>::table(index);
        let table = match () {
            () if is_of_application => A::OBJECTS,
            () if is_of_parameters => PARAMETERS,
            () => of_process_data.unwrap_or(TABLE),
        };
        Ok(object_dictionary::find(table, index, sub_index)?)
    }

    fn read(&self, object: Object) -> Result<Value, Abort> {
        let node_id = self.lss.active_node_id().map_or(0, |id| u32::from(id.get()));
        Ok(Value::Number(match object {
            Object::DeviceName => return Ok(Value::Text(self.device.name)),
            Object::HardwareVersion => return Ok(Value::Text(self.device.hardware_version)),
            Object::SoftwareVersion => return Ok(Value::Text(self.device.software_version)),
            Object::DeviceType => DEVICE_TYPE,
            Object::ErrorRegister => {
                let others = self.reports.map_or(0, Reports::error_register);
                (self.emergency.error_register() | others).into()
            }
            Object::NumberOfErrors => self.emergency.number_of_errors().into(),
            // CiA 301 names this code for object 1003h, and CANopenNode sends it, although the sub-index exists.
            Object::ErrorField(sub_index) => {
                self.emergency.error(sub_index).ok_or(Abort::NoData)?
            }
            Object::StoreParameters | Object::RestoreDefaultParameters => ON_COMMAND,
            Object::CobIdEmergency => u32::from(emergency::COB_ID) + node_id,
            Object::ProducerHeartbeatTime => self.nmt.heartbeat_ms().into(),
            Object::CommunicationErrorBehaviour => self.nmt.error_behaviour() as u32,
            Object::VendorId => self.lss.address_part(AddressPart::VendorId),
            Object::ProductCode => self.lss.address_part(AddressPart::ProductCode),
            Object::RevisionNumber => self.lss.address_part(AddressPart::RevisionNumber),
            Object::SerialNumber => self.lss.address_part(AddressPart::SerialNumber),
            Object::BusOffs => self.emergency.bus_offs().into(),
            Object::Overruns => self.emergency.overruns().into(),
            Object::TransmitErrorCounter => self.emergency.error_counters().transmit.into(),
            Object::ReceiveErrorCounter => self.emergency.error_counters().receive.into(),
            Object::HomeBitRate => self.bit_rate.home().map_or(0, |rate| rate.kbit_per_s().into()),
            Object::BitRateInUse => self.bit_rate.in_use().kbit_per_s().into(),
            Object::Rescues => self.bit_rate.rescues().into(),
            Object::HighestSubIndex(highest) => highest.into(),
            Object::Application(_) if A::OBJECTS.is_empty() => return Err(Abort::NoObject),
            Object::Application(field) => self.read_application(field)?,
            _ if ProcessData::<TPDOS, RPDOS, PRODUCERS>::IS_USED => {
                self.process_data.read(object, self.lss.active_node_id())?
            }
            _ => return Err(Abort::NoObject),
        }))
    }

    fn write(&mut self, entry: &Entry, value: u32) -> Result<Written, Abort> {
        match (entry.object, value) {
            (Object::NumberOfErrors, number) if number as u8 == 0 => {
                self.emergency.clear_history();
                Ok(Written::Now)
            }
            (Object::NumberOfErrors, _) => Err(Abort::InvalidValue),
            (Object::ProducerHeartbeatTime, ms) => {
                self.nmt.set_heartbeat_ms(ms as u16, self.now);
                Ok(Written::Now)
            }
            (Object::CommunicationErrorBehaviour, value) => {
                let behaviour = ErrorBehaviour::new(value as u8).ok_or(Abort::InvalidValue)?;
                self.nmt.set_error_behaviour(behaviour);
                Ok(Written::Now)
            }
            (Object::StoreParameters, SAVE) => self.request_store(entry, self.nmt.heartbeat_ms()),
            (Object::RestoreDefaultParameters, LOAD) => {
                self.request_store(entry, self.device.defaults.heartbeat_ms)
            }
            (Object::StoreParameters | Object::RestoreDefaultParameters, _) => {
                Err(Abort::NotStored)
            }
            (Object::Application(field), value) if !A::OBJECTS.is_empty() => self
                .write_application(
                    field,
                    value.to_le_bytes().get(..entry.data_type.size().into()).unwrap_or_default(),
                ),
            (object, value) if ProcessData::<TPDOS, RPDOS, PRODUCERS>::IS_USED => {
                let node = self.lss.active_node_id();
                self.process_data.write(object, value, node, A::OBJECTS)?;
                Ok(Written::Now)
            }
            _ => Err(Abort::ReadOnly),
        }
    }
}

impl<A: Application, const TPDOS: usize, const RPDOS: usize, const PRODUCERS: usize>
    Parts<'_, A, TPDOS, RPDOS, PRODUCERS>
{
    fn read_application(&self, field: u8) -> Result<u32, Abort> {
        let mut bytes = [0; 4];
        self.application.read(field, 0, &mut bytes);
        Ok(u32::from_le_bytes(bytes))
    }

    fn write_application(&mut self, field: u8, bytes: &[u8]) -> Result<Written, Abort> {
        let value = A::parse(field, bytes)?;
        self.application.accept(&value)?;
        self.application.set(value);
        Ok(Written::Now)
    }

    fn request_store(&mut self, entry: &Entry, heartbeat_ms: u16) -> Result<Written, Abort> {
        let download = Download { index: entry.index, sub_index: entry.sub_index };
        self.storing.request_by_sdo(download, heartbeat_ms)?;
        Ok(Written::Later)
    }
}

impl From<Busy> for Abort {
    fn from(_: Busy) -> Self {
        Self::Busy
    }
}
