//! The library of program updates, over flashes in memory: an exhaustive model, power cuts at each word, files, objects.

mod cuts;
mod device;
mod faults;
mod files;
mod flash;
mod model;
mod objects;
mod program;
mod program_side;
mod signed;
