//! Why a procedure failed.

use core::{error, fmt};

use lss_slave::lss::Request;

/// Why a procedure failed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum Error {
    /// No slave answers the request, which was repeated.
    NoAnswer(Request),
    /// A slave refuses the request.
    Refused {
        /// The request: 11, 13 or 17.
        request: Request,
        /// The error code of CiA 305. 1: out of range (11), not supported (13, 17). 2: the medium failed (17).
        code: u8,
        /// The manufacturer's code, if the error code is FFh.
        manufacturer_code: Option<u8>,
    },
    /// The answer has a value that CiA 305 does not permit.
    Unexpected {
        /// The request.
        request: Request,
        /// The data of the answer.
        answer: [u8; 8],
    },
    /// The answers contradict each other in every attempt: too many are lost or later than [`Timing`](crate::Timing)
    /// permits, or two slaves have one LSS address.
    Inconsistent,
}

/// The command specifier of the request, and what happened.
impl fmt::Display for Error {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let specifier = |request: &Request| {
            let [specifier, ..] = request.to_bytes();
            specifier
        };
        match self {
            Self::NoAnswer(request) => write!(f, "{:02X} is not answered", specifier(request)),
            Self::Refused { request, code, manufacturer_code } => {
                write!(f, "{:02X} is refused with error {code:02X}", specifier(request))?;
                match manufacturer_code {
                    Some(code) => write!(f, ", manufacturer's code {code:02X}"),
                    None => Ok(()),
                }
            }
            Self::Unexpected { request, answer } => {
                write!(f, "{:02X} is answered {answer:02X?}", specifier(request))
            }
            Self::Inconsistent => f.write_str("the answers contradict each other"),
        }
    }
}

impl error::Error for Error {}
