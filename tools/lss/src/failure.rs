//! Why a command failed, in words that say what to do, and its exit code.

use std::io;

use can_bus::{explain::explain, stop::Stop};
use canopen_node::{
    BitRate,
    lss::{REQUEST_COB_ID, RESPONSE_COB_ID, Request},
};
use lss_master::Error;
use thiserror::Error;

/// The outcome of a step of a command.
pub type Result<T = (), E = Failure> = std::result::Result<T, E>;

/// Why a command failed.
#[derive(Debug, Error)]
pub enum Failure {
    #[error(transparent)]
    Stop(#[from] Stop),
    /// Nobody answers.
    #[error("{0}")]
    NoAnswer(String),
    /// A board refuses, or the network is not as it must be.
    #[error("{0}")]
    Refused(String),
    #[error("cannot write: {0}")]
    Write(#[from] io::Error),
}

impl Failure {
    /// No board answers at this bit rate.
    pub fn nobody(rate: BitRate) -> Self {
        Self::NoAnswer(format!("nobody answers at {rate}. `lss find` looks for the bit rate"))
    }

    /// All problems, if there are any.
    pub fn of(problems: &[String]) -> Result<(), Self> {
        match problems {
            [] => Ok(()),
            problems => Err(Self::Refused(problems.join("\n"))),
        }
    }

    /// What is wrong with one board, in words; a failure that ends the run stays one.
    pub fn of_board(self) -> Result<String, Self> {
        match self {
            Self::Stop(_) => Err(self),
            failure => Ok(failure.to_string()),
        }
    }

    /// The exit code of the program.
    pub fn exit_code(&self) -> u8 {
        match self {
            Self::Refused(_) | Self::Write(_) => 1,
            Self::Stop(Stop::OtherMaster(_) | Stop::Bench(_)) => 1,
            Self::NoAnswer(_) => 3,
            Self::Stop(Stop::NoAdapter(_) | Stop::NoBitRate(_) | Stop::AdapterGone(_)) => 4,
            Self::Stop(Stop::Interrupted) => 130,
        }
    }
}

/// The error of a procedure in words, without the service's name "LSS".
pub fn words(error: Error) -> String {
    match error {
        Error::NoAnswer(request) => format!("no answer to {}", service(request)),
        Error::Refused { request, code, manufacturer_code } => {
            let [specifier, ..] = request.to_bytes();
            let answer = [specifier, code, manufacturer_code.unwrap_or(0), 0, 0, 0, 0, 0];
            format!("{} is {}", service(request), last_part(&explain(RESPONSE_COB_ID, &answer)))
        }
        error => error.to_string(),
    }
}

fn service(request: Request) -> String {
    let words = explain(REQUEST_COB_ID, &request.to_bytes());
    words.trim_start_matches("LSS ").to_owned()
}

/// The words from "refused" on.
fn last_part(words: &str) -> &str {
    words.find("refused").map_or(words, |at| &words[at..])
}

impl From<Error> for Failure {
    fn from(error: Error) -> Self {
        match error {
            Error::NoAnswer(_) => Self::NoAnswer(words(error)),
            error => Self::Refused(words(error)),
        }
    }
}
