//! The command line.

use std::{ffi::OsString, ops::RangeInclusive, path::PathBuf};

use can_bus::adapter::{Place, bit_rate};
use canopen_node::{BitRate, NodeId, lss::Address};
use clap::{CommandFactory, FromArgMatches, Parser, Subcommand};
use clap_complete::Shell;

use crate::{
    address::{self, Assigned, Which},
    commands::data_type,
};

/// The commands that one rarely needs.
const EXPERTS: &str = "For experts:
  identify    Ask whether any board has an LSS address within ranges; changes no state
  store       Let a board store its node-ID and its bit rate
  raw         Send one LSS request and print the answers";

/// Commission a CANopen network: LSS (CiA 305) through a CAN adapter
///
/// Every command leaves all boards in LSS waiting state, also after an error and after Ctrl-C; only `lss raw` sends
/// what you say. It ends with 0 if all was done, 1 if a board refuses or the network is not as it must be, 2 if the
/// command line is wrong, 3 if nobody answers, 4 without a working adapter, 130 after Ctrl-C, which is the good end
/// only of `lss list --watch`: 0.
#[derive(Parser)]
#[command(
    name = "lss",
    version = concat!(env!("CARGO_PKG_VERSION"), " (commit ", env!("COMMIT"), ")"),
    verbatim_doc_comment,
    next_help_heading = "Options of every command",
    after_help = EXPERTS,
    after_long_help = EXPERTS
)]
pub struct Arguments {
    /// The CAN adapter: `slcan:DEVICE[@BAUD]`, slcan:tcp:HOST:PORT, socketcan:INTERFACE; socketcan:INTERFACE@KBIT if
    /// the interface is up and its bit rate must stay
    #[arg(long, global = true, value_name = "ADAPTER", env = "LSS_ADAPTER")]
    pub adapter: Option<Place>,
    /// The bit rate of the network in kbit/s: 125, 125k or 125000; by default that of the interface, or 125
    #[arg(long, global = true, value_name = "KBIT", value_parser = bit_rate)]
    pub bit_rate: Option<BitRate>,
    /// The time in ms that the adapter takes for a frame and its answer, if it is longer than the adapter itself
    /// reports
    #[arg(long, global = true, value_name = "MS", default_value_t = 2)]
    pub latency: u16,
    /// Write all frames to FILE as `candump -l` does
    #[arg(long, global = true, value_name = "FILE")]
    pub log: Option<PathBuf>,
    /// Draw what was done with each board, and when, as an SVG picture
    #[arg(long, global = true, value_name = "FILE")]
    pub svg: Option<PathBuf>,
    /// Print each frame in words, on the standard error
    #[arg(long, global = true)]
    pub explain: bool,
    #[command(subcommand)]
    pub command: Command,
    /// The name of the command.
    #[arg(skip)]
    pub name: String,
}

impl Arguments {
    /// Reads a command line with the name of the program.
    ///
    /// # Errors
    /// It is wrong, or a request for help.
    pub fn read<T: Into<OsString> + Clone>(
        words: impl IntoIterator<Item = T>,
    ) -> Result<Self, clap::Error> {
        let matches = Self::command().try_get_matches_from(words)?;
        let name = matches.subcommand_name().unwrap_or_default().to_owned();
        Ok(Self { name, ..Self::from_arg_matches(&matches)? })
    }
}

/// The board that a command is for.
#[derive(clap::Args, Clone, Copy)]
pub struct Target {
    /// The LSS address of the board, as `lss inquire` prints it; without it, the only board on the bus
    #[arg(long, value_name = "V:P:R:S", value_parser = address::address)]
    pub address: Option<Address>,
}

/// The files, and how much is done.
#[derive(clap::Args)]
pub struct Apply {
    /// A table of the network (network.toml, as of `lss assign`), DCFs of nodes (*.dcf), or a list of them
    /// (nodelist.cpj)
    #[arg(value_name = "FILE", required = true)]
    pub files: Vec<PathBuf>,
    /// Only print the plan; ends with 1 if anything differs
    #[arg(long, visible_alias = "check")]
    pub plan: bool,
    /// Print the plan as JSON
    #[arg(long, requires = "plan")]
    pub json: bool,
    /// Compare each value, also of nodes whose configuration stamp says that they have them
    #[arg(long)]
    pub full: bool,
    /// Do not bring a node to NMT state pre-operational before its PDOs change
    #[arg(long)]
    pub keep_state: bool,
    /// Write a DCF for each node with the values that are on it, in the end, into this folder
    #[arg(long, value_name = "FOLDER")]
    pub write_dcf: Option<PathBuf>,
}

/// A node, or all.
#[derive(clap::Args, Clone, Copy)]
pub struct OneOrAll {
    #[arg(value_name = "NODE-ID", value_parser = address::node_id)]
    pub node: Option<NodeId>,
}

/// An object of a node.
#[derive(clap::Args)]
pub struct Object {
    #[arg(value_name = "NODE-ID", value_parser = address::node_id)]
    pub node: NodeId,
    /// Index and sub-index in hexadecimal, 1017 or 2101:1; with a data sheet also its name
    #[arg(value_name = "OBJECT")]
    pub object: String,
    /// Its data type: bool, i8, i16, i32, i64, u8, u16, u32, u64, f32, f64, text, hex
    #[arg(long = "type", value_name = "TYPE", value_parser = data_type, conflicts_with = "eds")]
    pub data_type: Option<u8>,
    /// The data sheet of the node
    #[arg(long, value_name = "FILE")]
    pub eds: Option<PathBuf>,
}

/// The update file, and where it goes.
#[derive(clap::Args)]
pub struct Update {
    /// The update file (NAME.update.bin)
    #[arg(value_name = "FILE")]
    pub file: PathBuf,
    /// The boards; without any, all boards on the bus that the file is for
    #[arg(value_name = "NODE-ID", value_parser = address::node_id)]
    pub nodes: Vec<NodeId>,
    /// Boards with a later version get the program, too, without a question
    #[arg(long)]
    pub yes: bool,
    /// Print JSON, in the end
    #[arg(long)]
    pub json: bool,
}

#[derive(Subcommand)]
pub enum Command {
    /// Find the bit rate of the network and the nodes on it: listens at all bit rates, and changes no state
    Find {
        /// Ask at each bit rate if nobody is heard. It disturbs a network that runs but was silent
        #[arg(long)]
        ask: bool,
        /// Print JSON
        #[arg(long)]
        json: bool,
    },
    /// List all nodes: node-ID, LSS address, name, version, NMT state, bit rate
    List {
        /// Print JSON; with --watch a line for each event
        #[arg(long)]
        json: bool,
        /// Go on until Ctrl-C: show states, heartbeats, boot-ups and emergencies. It only listens then, and asks each
        /// node that appears once
        #[arg(long)]
        watch: bool,
        /// Ask a node that does not tell its LSS address by SDO for it by LSS, if no other board is on the bus
        #[arg(long, conflicts_with = "watch")]
        ask: bool,
    },
    /// Give each board without a node-ID one that nobody has, store it and verify it by a reset
    Assign(Assign),
    /// Bring the network to the state that files describe: bit rate, node-IDs, values. Prints a plan first
    Apply(Apply),
    /// Switch all boards to another bit rate and store it; if one does not come, all go back
    SetRate {
        /// The new bit rate in kbit/s
        #[arg(value_name = "KBIT", value_parser = bit_rate)]
        rate: BitRate,
        /// The switch delay in ms, in which each board and the adapter must change the bit rate
        #[arg(long, value_name = "MS", default_value_t = 500, value_parser = clap::value_parser!(u16).range(20..=10_000))]
        delay: u16,
    },
    /// Install a program on one board after the other (CiA 302-3): download, start, confirm. A board that the file is not
    /// for is left alone, and a program that does not run is taken back
    #[command(verbatim_doc_comment)]
    Update(Update),
    /// Start a node, or all: NMT state operational
    Start(OneOrAll),
    /// Stop a node, or all: NMT state stopped, in which they answer to LSS but not to SDO
    Stop(OneOrAll),
    /// Reset a node, or all
    Reset(OneOrAll),
    /// Read a value of a node
    Read(Object),
    /// Write a value of a node, which it has until its next reset
    Write {
        #[command(flatten)]
        object: Object,
        /// The value, as in a data sheet: 500, 0x1F4, 1.5, a text
        #[arg(value_name = "VALUE", allow_hyphen_values = true)]
        value: String,
    },
    /// Ask a board for its LSS address and its node-ID
    Inquire {
        #[command(flatten)]
        target: Target,
        /// Print JSON
        #[arg(long)]
        json: bool,
    },
    /// Show which board it is: keeps it in LSS configuration state, in which its LEDs flicker (CiA 303-3), until you press
    /// Enter; without a terminal for 10 s
    Blink {
        /// The node-ID of the board, or its LSS address
        #[arg(value_name = "ID|V:P:R:S", value_parser = address::which)]
        which: Which,
    },
    /// Ask whether any board has an LSS address within ranges; changes no state
    #[command(hide = true)]
    Identify(Ranges),
    /// Give a board a node-ID
    SetId {
        /// 1 to 127, or none
        #[arg(value_name = "ID", value_parser = address::assigned)]
        id: Assigned,
        #[command(flatten)]
        target: Target,
        /// Store it, too: it stays after a power cut
        #[arg(long)]
        store: bool,
        /// Reset the communication of a board that has another node-ID, which takes the new one then
        #[arg(long)]
        reset: bool,
        /// Print JSON
        #[arg(long)]
        json: bool,
    },
    /// Let a board store its node-ID and its bit rate
    #[command(hide = true)]
    Store(Target),
    /// Send one LSS request and print the answers; zeros follow the bytes given
    #[command(hide = true)]
    Raw {
        /// The request in hexadecimal, such as 04 01
        #[arg(value_name = "BYTE", required = true, num_args = 1..=8, value_parser = address::byte)]
        bytes: Vec<u8>,
    },
    /// List the CAN adapters of this computer; the only one needs no --adapter
    Adapters,
    /// Print the completion of the commands for a shell
    Completion { shell: Shell },
}

impl Command {
    /// Whether it prints its result as JSON, and no words.
    pub fn is_json(&self) -> bool {
        match self {
            Self::Find { json, .. } | Self::Inquire { json, .. } | Self::SetId { json, .. } => {
                *json
            }
            Self::List { json, watch, .. } => *json && !watch,
            Self::Assign(Assign { json, .. }) | Self::Identify(Ranges { json, .. }) => *json,
            Self::Apply(Apply { json, .. }) | Self::Update(Update { json, .. }) => *json,
            _ => false,
        }
    }
}

/// How node-IDs are given.
#[derive(clap::Args)]
pub struct Assign {
    /// The lowest node-ID to give
    #[arg(long, value_name = "ID", value_parser = address::node_id, default_value = "1")]
    pub first: NodeId,
    /// The table of the network: its boards get their node-IDs first, and new boards come into it
    #[arg(long, value_name = "FILE")]
    pub table: Option<PathBuf>,
    /// A new board takes over the place of a missing one of the same product without a question, if there is one of
    /// each
    #[arg(long, requires = "table")]
    pub yes: bool,
    /// Wait for boards that you plug in one after the other, and say which node-ID each of them has got
    #[arg(long, conflicts_with = "yes")]
    pub one_at_a_time: bool,
    /// In the end, wait until somebody has switched the power off and on, and check that every board comes back
    #[arg(long)]
    pub power_check: bool,
    /// Print JSON
    #[arg(long)]
    pub json: bool,
}

/// The LSS addresses that are asked for. Numbers are decimal, or hexadecimal after 0x.
#[derive(clap::Args)]
pub struct Ranges {
    /// The vendor-ID
    #[arg(long, value_name = "NUMBER", value_parser = address::number)]
    pub vendor: u32,
    /// The product code
    #[arg(long, value_name = "NUMBER", value_parser = address::number)]
    pub product: u32,
    /// Revision numbers: FIRST..LAST or one number; by default all
    #[arg(long, value_name = "RANGE", value_parser = address::range, default_value = "0..0xFFFFFFFF")]
    pub revision: RangeInclusive<u32>,
    /// Serial numbers: FIRST..LAST or one number; by default all
    #[arg(long, value_name = "RANGE", value_parser = address::range, default_value = "0..0xFFFFFFFF")]
    pub serial: RangeInclusive<u32>,
    /// Print the LSS address of each board within the ranges, by ranges that are halved
    #[arg(long)]
    pub each: bool,
    /// Print JSON
    #[arg(long)]
    pub json: bool,
}
