//! The heartbeat (CiA 301, 7.2.8.3.2): its producer 1017h and its consumer 1016h.

pub(crate) mod consumer;
pub(crate) mod producer;
