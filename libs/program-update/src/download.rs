//! A download on its way into the flash.
