//! The table in the flash: the LSS address of the board with each node-ID.

use canopen_node::{
    NodeId, Settings,
    lss::Address,
    settings::{
        Found, Log,
        parameters::{Packer, Parameter},
    },
};
use canopen_stm32f4::SettingsFlash;

use crate::network::BIT_RATE;

/// The most boards.
pub const BOARDS: usize = 32;
/// The index of the table among the parameters of the settings log, and the most bytes of those.
const INDEX: u16 = 0x2200;
const LEN: usize = 6 + 16 * BOARDS;

pub struct Table {
    log: Log<SettingsFlash, LEN>,
    /// The LSS addresses of the boards with the node-IDs from 1 on, each number from its lowest byte on; zeros for none.
    rows: [[u8; 16]; BOARDS],
    /// It could be read, and has no address twice. Else nobody gets a node-ID.
    pub is_valid: bool,
}

impl Table {
    /// Reads the table. Both sectors of a new board are erased: 800 ms each at most.
    pub fn open(flash: SettingsFlash) -> Self {
        let (mut log, found) = Log::open_with_parameters(flash);
        let mut rows = [[0; 16]; BOARDS];
        let restored = log.restore(|parameter| {
            let places = rows.iter_mut().filter(|_| parameter.index == INDEX);
            places.zip(parameter.value.as_chunks().0).for_each(|(to, from)| *to = *from);
            parameter.index == INDEX
        });
        let is_lost = matches!(
            found,
            Found::Damaged | Found::ParametersDamaged | Found::OtherLayout | Found::MediumFailed(_)
        );
        let mut table = Self { log, rows, is_valid: restored.is_ok() && !is_lost };
        let is_once = |(_, board)| table.boards().filter(|(_, other)| *other == board).count() == 1;
        table.is_valid &= table.boards().all(is_once);
        table
    }

    /// The boards, each with its node-ID.
    pub fn boards(&self) -> impl Iterator<Item = (NodeId, Address)> + use<> {
        let rows = (1..).filter_map(NodeId::new).zip(self.rows);
        rows.filter(|(_, row)| *row != [0; 16])
            .map(|(node, row)| (node, Address::from_le_bytes(row)))
    }

    /// Stores the table with another board; returns whether it has. A power cut leaves this one or that before.
    pub fn put(&mut self, node: NodeId, board: Address) -> bool {
        let mut rows = self.rows;
        rows[usize::from(node.get()) - 1] = board.to_le_bytes();
        let mut packed = [0; LEN];
        let value = rows.as_flattened();
        Packer::new(&mut packed).put(&Parameter {
            index: INDEX,
            sub_index: 0,
            data_type: 0x0A,
            value,
        });
        let is_stored =
            self.log.store_with_parameters(Settings::new(BIT_RATE.into()), &packed).is_ok();
        if is_stored {
            self.rows = rows;
        }
        is_stored
    }
}
