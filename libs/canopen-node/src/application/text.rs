//! Strings of limited length, without an allocator.

use lss_slave::bytes::copy;

macro_rules! strings {
    ($($(#[$doc:meta])* $name:ident;)*) => {$(
        $(#[$doc])*
        #[derive(Clone, Copy, Debug, PartialEq, Eq)]
        #[cfg_attr(feature = "defmt", derive(defmt::Format))]
        pub struct $name<const N: usize> {
            bytes: [u8; N],
            len: usize,
        }

        impl<const N: usize> $name<N> {
            /// An empty string.
            pub const EMPTY: Self = Self { bytes: [0; N], len: 0 };

            /// A string with these bytes; `None` if there are more than `N`.
            pub fn from_bytes(bytes: &[u8]) -> Option<Self> {
                if bytes.len() > N {
                    return None;
                }
                let mut string = Self::EMPTY;
                string.len = copy(bytes, 0, &mut string.bytes);
                Some(string)
            }

            /// The bytes.
            pub fn as_bytes(&self) -> &[u8] {
                self.bytes.get(..self.len).unwrap_or(&self.bytes)
            }
        }

        impl<const N: usize> Default for $name<N> {
            fn default() -> Self {
                Self::EMPTY
            }
        }
    )*};
}

strings! {
    /// A VISIBLE_STRING of up to `N` bytes.
    Text;
    /// An OCTET_STRING of up to `N` bytes.
    OctetString;
}

impl<const N: usize> Text<N> {
    /// The text; empty if the bytes are not UTF-8.
    pub fn as_str(&self) -> &str {
        str::from_utf8(self.as_bytes()).unwrap_or_default()
    }
}
