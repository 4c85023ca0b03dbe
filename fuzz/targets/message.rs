//! LSS requests: a request read from any eight bytes is the same after it is written and read again.

#![no_main]

use libfuzzer_sys::fuzz_target;
use canopen_node::lss::Request;

fuzz_target!(|data: [u8; 8]| {
    if let Some(request) = Request::from_bytes(&data) {
        let bytes = request.to_bytes();
        assert_eq!(bytes[0], data[0]);
        assert_eq!(Request::from_bytes(&bytes), Some(request));
    }
});
