//! The library of program updates, over flashes in memory: an exhaustive model, power cuts at each word, files, objects.

mod model;
mod program;
