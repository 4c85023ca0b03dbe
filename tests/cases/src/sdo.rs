//! SDO 01..30: the SDO server (CiA 301, 7.2.4), by raw messages.

use testkit::{
    sdo_messages::crc,
    sdo_messages::{initiate, segment},
};

use crate::abort::*;
use crate::{
    Address, Bench, Case, Command, Group, Step,
    bench::{abort_code, name},
    eds::{Entry, Kind},
};

pub const GROUP: Group = Group { name: "SDO", prepare: |bench| bench.restore(), cases: CASES };

const CASES: &[Case] = &[
    Case::new("1000h is read by an expedited upload", device_type),
    Case::new(
        "A communication parameter is read and takes the same value again",
        read_and_write_back,
    ),
    Case::new("1000h cannot be written", write_device_type),
    Case::new("A write-only value cannot be read", read_write_only),
    Case::new("1000h has no sub-index 1", no_such_sub_index),
    Case::new("1004h does not exist", no_such_object),
    Case::new("An unknown command specifier is aborted", unknown_command),
    Case::new("A shorter value than four bytes refuses four", too_long),
    Case::new("A longer value than one byte refuses one", too_short),
    Case::new("A value above the high limit is refused", too_high),
    Case::new("A value below the low limit is refused", too_low),
    Case::new("1200h holds the predefined COB-IDs", default_server),
    Case::new("1000h is read, in segments if the server chooses so", device_type_in_any_way),
    Case::new("100Ch takes a download in segments", |bench| segmented(bench, GUARD_TIME)),
    Case::new("1017h takes a download in segments", |bench| segmented(bench, HEARTBEAT)),
    Case::new("A value of more than four bytes is uploaded in segments", upload_in_segments),
    Case::new("A segment with the wrong toggle bit is aborted", wrong_toggle),
    Case::new("A value in segments is that of the data sheet", text_in_segments),
    Case::new("1000h is read by a block upload without CRC", block_upload_of_device_type),
    Case::new("100Ch takes a block download without CRC", |bench| {
        block_download(bench, GUARD_TIME, false)
    }),
    Case::new("1017h takes a block download without CRC", |bench| {
        block_download(bench, HEARTBEAT, false)
    }),
    Case::new("A value of several segments is read by a block upload without CRC", |bench| {
        block_upload_of_text(bench, false, false)
    }),
    Case::new("A value of several segments is read by a block upload with CRC", |bench| {
        block_upload_of_text(bench, true, false)
    }),
    Case::new("100Ch takes a block download with CRC", |bench| {
        block_download(bench, GUARD_TIME, true)
    }),
    Case::new("1017h takes a block download with CRC", |bench| {
        block_download(bench, HEARTBEAT, true)
    })
    .with_remark("The tool writes 0, whose CRC is 0; this case writes 1000 and sends the CRC."),
    Case::new("A block size of 128 is aborted", wrong_block_size),
    Case::new("A confirmation of segment 128 is aborted", wrong_sequence_number).with_remark(
        "The tool takes 0504 0001h for a device without block transfer and skips; here the case \
             passes, since block transfer has begun.",
    ),
    Case::new("Further SDO servers are either in the data sheet or do not exist", further_servers),
    Case::new("Reset communication restores the COB-IDs of further SDO servers", |bench| {
        restored_channels(bench, 0x1201..0x1280, false)
    }),
    Case::new("1010h keeps the COB-IDs of SDO clients", |bench| {
        restored_channels(bench, 0x1280..0x1300, true)
    }),
];

const DEVICE_TYPE: Address = (0x1000, 0);
const GUARD_TIME: Address = (0x100C, 0);
const HEARTBEAT: Address = (0x1017, 0);
const BLOCK_SIZE: u8 = 20;

fn device_type(bench: &mut Bench) -> Step {
    let answer = bench.ask(initiate(0x40, DEVICE_TYPE, 0))?;
    bench.check(answer[..4] == [0x43, 0x00, 0x10, 0], "43 00 10 00 and four bytes")
}

fn device_type_in_any_way(bench: &mut Bench) -> Step {
    let data = bench.read(DEVICE_TYPE)?;
    bench.check(data.len() == 4, "four bytes")
}

/// The first value that satisfies `is_it`, or a skip that says what is missing.
pub fn find(bench: &Bench, missing: &str, is_it: impl Fn(&Entry) -> bool) -> Step<Entry> {
    match bench.eds.entries().find(|entry| is_it(entry)) {
        Some(entry) => Ok(entry.clone()),
        None => bench.skip(format!("the EDS has no {missing}")),
    }
}

/// Whether the value may be written at any time without an effect: PDOs must be invalid first.
fn is_plain(entry: &Entry) -> bool {
    let index = entry.address.0;
    let acts = entry.acts_on_write() || matches!(index, 0x1010 | 0x1011 | 0x1400..=0x1BFF);
    entry.is_number() && entry.can_be_written() && entry.can_be_read() && !acts
}

fn read_and_write_back(bench: &mut Bench) -> Step {
    let is_it = |entry: &Entry| (0x1000..0x2000).contains(&entry.address.0) && is_plain(entry);
    let Entry { address, .. } = find(bench, "rw value from 1000h to 1FFFh", is_it)?;
    let data = bench.read(address)?;
    bench.write(address, &data)
}

fn write_device_type(bench: &mut Bench) -> Step {
    let data = bench.read(DEVICE_TYPE)?;
    bench.refuses(DEVICE_TYPE, &data, READ_ONLY)?;
    Ok(())
}

fn read_write_only(bench: &mut Bench) -> Step {
    let Entry { address, .. } = find(bench, "write-only value", |entry| !entry.can_be_read())?;
    bench.expect_abort(initiate(0x40, address, 0), WRITE_ONLY)?;
    Ok(())
}

fn no_such_sub_index(bench: &mut Bench) -> Step {
    bench.expect_abort(initiate(0x40, (0x1000, 1), 0), &[NO_SUB_INDEX, GENERAL])?;
    Ok(())
}

fn no_such_object(bench: &mut Bench) -> Step {
    bench.expect_abort(initiate(0x40, (0x1004, 0), 0), &[NO_OBJECT, GENERAL])?;
    Ok(())
}

fn unknown_command(bench: &mut Bench) -> Step {
    bench.expect_abort(initiate(0xE0, DEVICE_TYPE, 0), &[UNKNOWN_COMMAND, GENERAL])?;
    Ok(())
}

/// A value of `lengths` bytes takes what it holds, but not with `wrong` bytes.
fn wrong_length(bench: &mut Bench, lengths: &[usize], wrong: usize, codes: &[u32]) -> Step {
    let is_it = |entry: &Entry| {
        is_plain(entry) && entry.size().is_some_and(|length| lengths.contains(&length))
    };
    let missing = format!("rw number of {lengths:?} bytes");
    let Entry { address, .. } = find(bench, &missing, is_it)?;
    let mut data = bench.read(address)?;
    data.resize(wrong, 0);
    bench.refuses(address, &data, codes)?;
    Ok(())
}

fn too_long(bench: &mut Bench) -> Step {
    wrong_length(bench, &[1, 2], 4, &[WRONG_LENGTH, TOO_LONG, GENERAL])
}

fn too_short(bench: &mut Bench) -> Step {
    wrong_length(bench, &[2, 4], 1, &[WRONG_LENGTH, TOO_SHORT, GENERAL])
}

fn too_high(bench: &mut Bench) -> Step {
    let node = bench.node;
    let above = |entry: &Entry| {
        let (_, most) = entry.range()?;
        entry.high(node).filter(|high| *high < most && is_plain(entry)).map(|high| high + 1)
    };
    let Some(entry) = bench.eds.entries().find(|entry| above(entry).is_some()).cloned() else {
        // CiA 301 allows 0 only.
        bench.needs((0x1003, 0))?;
        bench.refuses((0x1003, 0), &[0xFF], ABOVE_LIMIT)?;
        return Ok(());
    };
    let value = above(&entry).unwrap_or_default();
    bench.refuses(entry.address, &entry.of_number(value), ABOVE_LIMIT)?;
    Ok(())
}

fn too_low(bench: &mut Bench) -> Step {
    let node = bench.node;
    let below = |entry: &Entry| {
        let (least, _) = entry.range()?;
        entry.low(node).filter(|low| *low > least && is_plain(entry)).map(|low| low - 1)
    };
    let entry = find(bench, "rw number with a low limit", |entry| below(entry).is_some())?;
    let value = below(&entry).unwrap_or_default();
    bench.refuses(entry.address, &entry.of_number(value), BELOW_LIMIT)?;
    Ok(())
}

fn default_server(bench: &mut Bench) -> Step {
    bench.needs((0x1200, 1))?;
    for (sub_index, base) in [(1, 0x600), (2, 0x580)] {
        let cob_id = bench.number((0x1200, sub_index))?;
        let expected = base + u64::from(bench.node);
        bench.check(cob_id == expected, format!("1200h sub {sub_index} is {expected:03X}h"))?;
    }
    Ok(())
}

fn segmented(bench: &mut Bench, address: Address) -> Step {
    bench.needs(address)?;
    let outcome = bench.download_segments(address, &[0, 0])?;
    bench.check(outcome.is_ok(), format!("{} takes 0 in segments", name(address)))?;
    let time = bench.number(address)?;
    bench.check(time == 0, "it is 0 then")
}

/// A readable value of more than four bytes: the longest text, or else a number.
fn long_value(bench: &Bench) -> Step<Entry> {
    let length = |entry: &&Entry| entry.default(bench.node).map_or(0, |text| text.len());
    let is_text = |entry: &&Entry| entry.kind() == Kind::Text && entry.can_be_read();
    let text = bench.eds.entries().filter(is_text).max_by_key(length);
    match text.filter(|text| length(text) > 4) {
        Some(text) => Ok(text.clone()),
        None => find(bench, "value of more than four bytes", |entry| {
            entry.can_be_read() && entry.size().is_some_and(|size| size > 4)
        }),
    }
}

fn upload_in_segments(bench: &mut Bench) -> Step {
    let Entry { address, .. } = long_value(bench)?;
    let data = bench.read(address)?;
    bench.check(data.len() > 4, "more than four bytes")
}

fn wrong_toggle(bench: &mut Bench) -> Step {
    let Entry { address, .. } = long_value(bench)?;
    let answer = bench.ask(initiate(0x40, address, 0))?;
    bench.check(matches!(answer[0], 0x40 | 0x41), "40 or 41: segments follow")?;
    // The first segment has toggle bit 0.
    bench.expect_abort(segment(0x70, &[]), &[WRONG_TOGGLE])?;
    Ok(())
}

fn text_in_segments(bench: &mut Bench) -> Step {
    let entry = long_value(bench)?;
    let data = bench.read(entry.address)?;
    match entry.default(bench.node) {
        Some(default) => {
            bench.check(data == default, format!("{:?}", String::from_utf8_lossy(&default)))
        }
        None => Ok(()),
    }
}

/// Reads a value by a block upload, with a check of its CRC if that is wanted. With `repeats` the first block is
/// confirmed up to its first segment only.
pub fn block_upload(
    bench: &mut Bench,
    address: Address,
    has_crc: bool,
    mut repeats: bool,
) -> Step<Vec<u8>> {
    let begin = initiate(if has_crc { 0xA4 } else { 0xA0 }, address, BLOCK_SIZE.into());
    let answer = bench.ask(begin)?;
    if abort_code(&answer) == Some(UNKNOWN_COMMAND) {
        return bench.skip("the device has no block transfer");
    }
    let is_upload = matches!(answer[0], 0xC0 | 0xC2 | 0xC4 | 0xC6) && answer[1..4] == begin[1..4];
    bench.check(is_upload, "C0, C2, C4 or C6: the answer to a block upload")?;
    let server_has_crc = answer[0] & 4 != 0;
    let mut data = Vec::new();
    bench.say(segment(0xA3, &[]))?;
    loop {
        let (mut count, confirmed_before) = (0, data.len());
        let is_last = loop {
            let segment = bench.answer()?;
            count += 1;
            bench.check(segment[0] & 0x7F == count, format!("segment {count}"))?;
            data.extend(&segment[1..]);
            let is_last = segment[0] & 0x80 != 0;
            if is_last || count == BLOCK_SIZE {
                break is_last;
            }
        };
        let is_repeated = std::mem::take(&mut repeats) && count > 1;
        if is_repeated {
            count = 1;
            data.truncate(confirmed_before + 7);
        }
        bench.say(segment(0xA2, &[count, BLOCK_SIZE]))?;
        if is_last && !is_repeated {
            break;
        }
    }
    let end = bench.answer()?;
    bench.check(
        end[0] & 0xE3 == 0xC1,
        "C1 and the number of unused bytes: the end of the transfer",
    )?;
    data.truncate(data.len() - usize::from(end[0] >> 2 & 7));
    let expected = if has_crc && server_has_crc { crc(&data) } else { 0 };
    let is_right = u16::from_le_bytes([end[1], end[2]]) == expected;
    bench.check(is_right, format!("the CRC {expected:04X}h"))?;
    bench.say(segment(0xA1, &[]))?;
    let size = u32::from_le_bytes([answer[4], answer[5], answer[6], answer[7]]);
    let is_right = answer[0] & 2 == 0 || size as usize == data.len();
    bench.check(is_right, format!("{size} bytes, as the server said"))?;
    Ok(data)
}

fn block_upload_of_device_type(bench: &mut Bench) -> Step {
    let data = block_upload(bench, DEVICE_TYPE, false, false)?;
    let same = bench.read(DEVICE_TYPE)?;
    bench.check(data == same, "the bytes of an expedited upload")
}

pub fn block_upload_of_text(bench: &mut Bench, has_crc: bool, repeats: bool) -> Step {
    let Entry { address, .. } = long_value(bench)?;
    let data = block_upload(bench, address, has_crc, repeats)?;
    let same = bench.read(address)?;
    bench.check(data == same, "the bytes of an upload in segments")
}

fn block_download(bench: &mut Bench, address: Address, has_crc: bool) -> Step {
    bench.needs(address)?;
    let data = if has_crc { 1000_u16.to_le_bytes() } else { [0, 0] };
    let begin = initiate(if has_crc { 0xC6 } else { 0xC2 }, address, 2);
    let answer = bench.ask(begin)?;
    if abort_code(&answer) == Some(UNKNOWN_COMMAND) {
        return bench.skip("the device has no block transfer");
    }
    let is_download = matches!(answer[0], 0xA0 | 0xA4) && answer[1..4] == begin[1..4];
    bench.check(is_download && answer[4] > 0, "A0 or A4 and a block size")?;
    let answer = bench.ask(segment(0x81, &data))?;
    bench.check(answer[..2] == [0xA2, 1], "A2 01: the block is confirmed")?;
    let check = if has_crc { crc(&data).to_le_bytes() } else { [0, 0] };
    // Five bytes of the last segment are unused.
    let answer = bench.ask(segment(0xC1 | 5 << 2, &check))?;
    bench.check(answer[0] == 0xA1, "A1: the transfer is complete")?;
    let time = bench.read(address)?;
    bench.check(time == data, "the new value")
}

fn wrong_block_size(bench: &mut Bench) -> Step {
    let accepted = [UNKNOWN_COMMAND, WRONG_BLOCK_SIZE, GENERAL];
    bench.expect_abort(initiate(0xA0, DEVICE_TYPE, 128), &accepted)?;
    Ok(())
}

fn wrong_sequence_number(bench: &mut Bench) -> Step {
    let answer = bench.ask(initiate(0xA0, DEVICE_TYPE, BLOCK_SIZE.into()))?;
    if abort_code(&answer) == Some(UNKNOWN_COMMAND) {
        return bench.skip("the device has no block transfer");
    }
    let only = bench.ask(segment(0xA3, &[]))?;
    bench.check(only[0] == 0x81, "81: the only segment")?;
    let accepted = [UNKNOWN_COMMAND, WRONG_SEQUENCE_NUMBER, GENERAL];
    bench.expect_abort(segment(0xA2, &[128, BLOCK_SIZE]), &accepted)?;
    Ok(())
}

fn further_servers(bench: &mut Bench) -> Step {
    for index in 0x1201..0x1280 {
        match bench.eds.get((index, 1)) {
            Some(_) => drop(bench.number((index, 1))?),
            None => drop(bench.expect_abort(initiate(0x40, (index, 1), 0), &[NO_OBJECT, GENERAL])?),
        }
    }
    Ok(())
}

/// The COB-IDs of SDO channels that can be written lose a change by reset communication, or keep it by 1010h.
fn restored_channels(bench: &mut Bench, indices: std::ops::Range<u16>, is_saved: bool) -> Step {
    let is_it = |entry: &&Entry| {
        let (index, sub_index) = entry.address;
        indices.contains(&index) && matches!(sub_index, 1 | 2) && entry.can_be_written()
    };
    let addresses: Vec<_> = bench.eds.entries().filter(is_it).map(|entry| entry.address).collect();
    if addresses.is_empty() {
        let (first, last) = (indices.start, indices.end - 1);
        return bench.skip(format!("the EDS has no writable COB-ID in {first:04X}h..{last:04X}h"));
    }
    for address in addresses {
        let before = bench.number(address)? as u32;
        let changed = before ^ 1 << 31;
        bench.write(address, &changed.to_le_bytes())?;
        if is_saved {
            bench.needs((0x1010, 1))?;
            bench.write((0x1010, 1), b"save")?;
        }
        bench.reset(Command::ResetCommunication)?;
        let expected = if is_saved { changed } else { before };
        let after = bench.number(address)? as u32;
        bench.check(after == expected, format!("{expected:08X}h after reset communication"))?;
    }
    Ok(())
}
