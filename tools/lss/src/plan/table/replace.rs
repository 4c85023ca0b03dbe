//! Another board in the place of one in the table: the file keeps its order, its comments and all other keys.

use canopen_node::{NodeId, lss::Address};
use toml_edit::{DocumentMut, Item, TableLike, Value};

use crate::address;

/// The text with another address for a node-ID; `None` if it does not have it.
pub fn replaced(text: &str, id: NodeId, board: &Address) -> Option<String> {
    let mut document: DocumentMut = text.parse().ok()?;
    let is_done = match document.get_mut("node")? {
        Item::ArrayOfTables(tables) => tables.iter_mut().any(|table| set(table, id, board)),
        Item::Value(Value::Array(array)) => {
            let mut tables = array.iter_mut().filter_map(Value::as_inline_table_mut);
            tables.any(|table| set(table, id, board))
        }
        _ => false,
    };
    is_done.then(|| document.to_string())
}

/// Sets the address of a table if it is that of the node-ID.
fn set(table: &mut dyn TableLike, id: NodeId, board: &Address) -> bool {
    if table.get("id").and_then(Item::as_integer) != Some(id.get().into()) {
        return false;
    }
    let Some(value) = table.get_mut("address").and_then(Item::as_value_mut) else { return false };
    // The comment behind it.
    let decor = value.decor().clone();
    *value = address::text(board).into();
    *value.decor_mut() = decor;
    true
}

#[cfg(test)]
mod tests {
    use super::*;

    const BOARD: Address =
        Address { vendor_id: 1, product_code: 2, revision_number: 3, serial_number: 0xFF };

    #[test]
    fn only_the_address_changes() {
        let five = NodeId::new(5).expect("a node-ID");
        let before = "# plant 3\n[[node]]\nid=7\naddress = \"1:2:3:4\"\n\n[[node]] # the pump\naddress = '1:2:3:5'   # left\n\
                      id = 5\nname = \"pump\"\n[node.values]\n2100 = 3\n# end\n";
        let after = before.replace("'1:2:3:5'", "\"00000001:00000002:00000003:000000FF\"");
        assert_eq!(replaced(before, five, &BOARD), Some(after));
        let inline = "node = [{ id = 5, address = \"1:2:3:5\" }, # one\n  { id = 6, address = \"1:2:3:6\" }]\n";
        let after = inline.replace("1:2:3:5", "00000001:00000002:00000003:000000FF");
        assert_eq!(replaced(inline, five, &BOARD), Some(after));
        for without in
            ["", "node = 5", "[[node]]\nid = 6\naddress = \"1:2:3:4\"", "[[node]]\nid = 5"]
        {
            assert_eq!(replaced(without, five, &BOARD), None, "{without}");
        }
    }
}
