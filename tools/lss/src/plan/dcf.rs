//! The configuration file of a device (DCF, CiA 306): its data sheet with the values that are on the node.

use std::{collections::BTreeMap, fs, path::Path};

use can_bus::{
    eds::{self, Line, encode},
    sdo,
};
use canopen_node::{BitRate, NodeId, lss::Address};

use super::{
    node::{Node, STAMP},
    sheet::{Sheet, address_words},
};
use crate::{
    failure::{Failure, Result},
    session::Session,
};

/// Writes `node_5.dcf` into the folder, with the values that configure the node with this node-ID; returns its name, and what
/// has no place there.
pub fn write(
    session: &mut Session,
    folder: &Path,
    node: &Node,
    sheet: &Sheet,
    address: &Address,
    id: NodeId,
) -> Result<String> {
    let (mut values, mut lost) = (BTreeMap::new(), Vec::new());
    for entry in sheet.eds.entries() {
        // The stamp proves values of this board, and not those that a person may write into the file.
        if !sheet.configures(entry) || !entry.can_be_read() || entry.address.0 == STAMP {
            continue;
        }
        session
            .progress
            .say(|| format!("{}: reading {}", node.words(), node.value_words(entry.address)));
        // Some objects cannot be read in each state, and a value without a notation cannot stand in the file.
        let (index, sub_index) = entry.address;
        let value = sdo::read(&mut session.bus, id.get(), index, sub_index)?;
        match value.ok().and_then(|bytes| entry.notation(&bytes)) {
            Some(text) => _ = values.insert(entry.address, text),
            None => lost.push(address_words(entry.address, Some(sheet))),
        }
    }
    let name = format!("node_{id}.dcf");
    let rate = session.bus.rate();
    let text = content(sheet, &values, &name, &commissioning(node, address, id, rate));
    let path = folder.join(&name);
    let bytes = encode(&text, sheet.eds.is_latin);
    let written = fs::create_dir_all(folder).and_then(|()| fs::write(&path, bytes));
    match written {
        Ok(()) if lost.is_empty() => Ok(path.display().to_string()),
        Ok(()) => Ok(format!("{}, without {}", path.display(), lost.join(", "))),
        Err(error) => Err(Failure::Refused(format!("cannot write {}: {error}", path.display()))),
    }
}

fn commissioning(node: &Node, address: &Address, id: NodeId, rate: BitRate) -> String {
    let name: String = node.name.as_deref().unwrap_or("").chars().filter(char::is_ascii).collect();
    format!(
        "[DeviceComissioning]\nNodeID={id}\nNodeName={name}\nBaudrate={}\nNetNumber=1\nNetworkName=\nCANopenManager=0\n\
         LSS_SerialNumber=0x{:08X}\n",
        rate.kbit_per_s(),
        address.serial_number
    )
}

/// The data sheet with other values. It otherwise stays as it is.
fn content(
    sheet: &Sheet,
    values: &BTreeMap<eds::Address, String>,
    name: &str,
    commissioning: &str,
) -> String {
    let of_compact = compact(sheet, values);
    let mut text = String::new();
    let mut section = String::new();
    let mut is_left_out = false;
    for line in sheet.eds.text.lines().map(str::trim_end) {
        if let Line::Section(header) = Line::read(line) {
            section = header.to_ascii_lowercase();
            is_left_out = matches!(&*section, "devicecomissioning" | "devicecommissioning")
                || of_compact.contains_key(&*section);
            if !is_left_out {
                text += &format!("{line}\n");
                text += &value_line(sheet, &section, values);
            }
            continue;
        }
        let key = line.split_once('=').map_or("", |(key, _)| key.trim()).to_ascii_lowercase();
        match &*key {
            _ if is_left_out => {}
            "parametervalue" => {}
            "lasteds" if section == "fileinfo" => {}
            "filename" if section == "fileinfo" => {
                let data_sheet = sheet.path.file_name().unwrap_or_default().to_string_lossy();
                text += &format!("FileName={name}\nLastEDS={data_sheet}\n");
            }
            _ => text += &format!("{line}\n"),
        }
    }
    for (section, lines) in of_compact {
        text += &format!("\n[{section}]\n{lines}");
    }
    format!("{text}\n{commissioning}")
}

/// The line with the value of a section such as `2101sub1`.
fn value_line(sheet: &Sheet, section: &str, values: &BTreeMap<eds::Address, String>) -> String {
    let is_compact = sheet.eds.number(section, "CompactSubObj").is_some_and(|count| count > 0);
    let address = eds::address(section).filter(|_| !is_compact);
    let value = address.and_then(|address| values.get(&address));
    value.map_or_else(String::new, |value| format!("ParameterValue={value}\n"))
}

/// The sections with the values of objects whose elements share one section.
fn compact(sheet: &Sheet, values: &BTreeMap<eds::Address, String>) -> BTreeMap<String, String> {
    let mut sections = BTreeMap::new();
    for index in sheet.eds.indices() {
        let section = format!("{index:04x}");
        if sheet.eds.number(&section, "CompactSubObj").is_none_or(|count| count <= 0) {
            continue;
        }
        let of_object = values.range((index, 1)..=(index, 0xFE));
        let lines: Vec<String> =
            of_object.map(|((_, number), value)| format!("{number}={value}\n")).collect();
        let text = format!("NrOfEntries={}\n{}", lines.len(), lines.concat());
        sections.insert(format!("{section}value"), text);
    }
    sections
}

#[cfg(test)]
mod tests {
    use can_bus::eds::Eds;

    use super::*;

    #[test]
    fn elements_that_share_one_section_have_their_values_in_another() {
        let object = |index: &str, count: u8| {
            format!(
                "[{index}]\nParameterName=A\nDataType=5\nAccessType=rw\nCompactSubObj={count}\n"
            )
        };
        let tool = "[Tool]\nFileName=a\nLastEDS=b\n";
        let text = object("2000", 2) + &object("2001", 0) + tool;
        let sheet = Sheet { eds: Eds::parse(&text), path: "io.eds".into() };
        let values =
            [((0x2000, 0), "2"), ((0x2000, 1), "5"), ((0x2000, 2), "6"), ((0x2001, 0), "7")];
        let values = values.map(|(address, value)| (address, value.to_owned())).into();
        let written = content(&sheet, &values, "node_5.dcf", "");
        assert!(written.starts_with("[2000]\nParameterName"), "{written}");
        assert!(written.contains("[2001]\nParameterValue=7\n"), "{written}");
        assert!(written.contains(tool), "{written}");
        let sections = written.matches("value]").count();
        assert!(written.contains("\n[2000value]\nNrOfEntries=2\n1=5\n2=6\n"), "{written}");
        assert_eq!(sections, 1, "{written}");
    }
}
