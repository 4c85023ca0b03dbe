//! What the node answers for each object of the dictionary, and what writing to it does.

use super::Node;
use crate::{
    emergency,
    lss::AddressPart,
    nmt::ErrorBehaviour,
    object_dictionary::{Entry, Object},
    sdo::{Abort, Objects, Server, Value, Written},
};

const SAVE: u32 = u32::from_le_bytes(*b"save");
const LOAD: u32 = u32::from_le_bytes(*b"load");
/// 1010h and 1011h, read: the device stores, or restores, on command.
const ON_COMMAND: u32 = 1;
/// 1000h: no device profile.
const DEVICE_TYPE: u32 = 0;

impl Objects for Node {
    fn server(&mut self) -> &mut Server {
        &mut self.sdo
    }

    fn read(&self, object: Object) -> Result<Value, Abort> {
        let node_id = self.node_id().map_or(0, |id| u32::from(id.get()));
        Ok(Value::Number(match object {
            Object::DeviceName => return Ok(Value::Text(self.device.name)),
            Object::HardwareVersion => return Ok(Value::Text(self.device.hardware_version)),
            Object::SoftwareVersion => return Ok(Value::Text(self.device.software_version)),
            Object::DeviceType => DEVICE_TYPE,
            Object::ErrorRegister => self.emergency.error_register().into(),
            Object::NumberOfErrors => self.emergency.number_of_errors().into(),
            // The code that CiA 301 names for object 1003h, and that CANopenNode sends: the sub-index does exist.
            Object::ErrorField(sub_index) => {
                self.emergency.error(sub_index).ok_or(Abort::NoData)?
            }
            Object::StoreParameters | Object::RestoreDefaultParameters => ON_COMMAND,
            Object::CobIdEmergency => u32::from(emergency::COB_ID) + node_id,
            Object::ProducerHeartbeatTime => self.heartbeat_ms.into(),
            Object::CommunicationErrorBehaviour => self.error_behaviour as u32,
            Object::VendorId => self.lss.address_part(AddressPart::VendorId),
            Object::ProductCode => self.lss.address_part(AddressPart::ProductCode),
            Object::RevisionNumber => self.lss.address_part(AddressPart::RevisionNumber),
            Object::SerialNumber => self.lss.address_part(AddressPart::SerialNumber),
            Object::BusOffs => self.emergency.bus_offs().into(),
            Object::Overruns => self.emergency.overruns().into(),
            Object::TransmitErrorCounter => self.error_counters.0.into(),
            Object::ReceiveErrorCounter => self.error_counters.1.into(),
            Object::HomeBitRate => {
                self.supervision.home().map_or(0, |rate| rate.kbit_per_s().into())
            }
            Object::BitRateInUse => self.supervision.bit_rate().kbit_per_s().into(),
            Object::Rescues => self.supervision.rescues().into(),
            Object::HighestSubIndex(highest) => highest.into(),
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
                self.heartbeat_ms = ms as u16;
                self.heartbeat_is_new = true;
                Ok(Written::Now)
            }
            (Object::CommunicationErrorBehaviour, value) => {
                self.error_behaviour =
                    ErrorBehaviour::new(value as u8).ok_or(Abort::InvalidValue)?;
                Ok(Written::Now)
            }
            (Object::StoreParameters, SAVE) => self.request_store(entry, self.heartbeat_ms),
            (Object::RestoreDefaultParameters, LOAD) => {
                self.request_store(entry, self.device.heartbeat_ms)
            }
            (Object::StoreParameters | Object::RestoreDefaultParameters, _) => {
                Err(Abort::NotStored)
            }
            _ => Err(Abort::ReadOnly),
        }
    }
}
