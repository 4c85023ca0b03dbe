//! The stored parameters of a node with an application, with unknown values.

use core::hint::black_box;

use canopen_node::settings::{
    Log,
    parameters::{Packer, Parameter, unpack},
};

use super::{Flash, Objects, ObjectsNode, any, any_device, any_settings};

const STORED_LEN: usize = ObjectsNode::STORED_LEN;
type ParametersLog = Log<Flash, STORED_LEN>;

fn any_bytes() -> &'static [u8] {
    any(&[])
}

pub fn keep() {
    let (mut log, found) = any(ParametersLog::open_with_parameters(Flash));
    black_box(found);
    let mut node = ObjectsNode::with_application(any_device(), any(None), any(Objects::new()));
    black_box(black_box(&mut log).restore(|parameter| node.restore(parameter))).ok();
    black_box(log.parameters());
    black_box(black_box(&mut log).store(any_settings())).ok();
    black_box(black_box(&mut log).store_with_parameters(any_settings(), any_bytes())).ok();

    let mut packed = [0; STORED_LEN];
    let value = any_bytes();
    let parameter = Parameter { index: any(0), sub_index: any(0), data_type: any(0), value };
    Packer::new(any(&mut packed)).put(&parameter);
    unpack(any_bytes()).for_each(|parameter| {
        black_box(parameter);
    });
}
