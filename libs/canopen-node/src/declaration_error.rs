//! The errors of a product's declarations: messages that are put together at compile time.

/// The message of an error, which ends the build.
#[derive(Clone, Copy, Debug)]
pub struct DeclarationError {
    text: [u8; 200],
    len: usize,
}

impl DeclarationError {
    /// An error of an object.
    pub const fn of_object(index: u16, sub_index: u8) -> Self {
        Self::new("object ").object(index, sub_index).text(": ")
    }

    /// An error of a PDO with this name and number.
    pub const fn of_pdo(name: &str, number: usize) -> Self {
        Self::new(name).text(" ").number(number).text(": ")
    }

    /// An error with this message.
    pub const fn new(text: &str) -> Self {
        Self { text: [0; 200], len: 0 }.text(text)
    }

    /// Adds a text.
    #[must_use]
    pub const fn text(mut self, text: &str) -> Self {
        let mut bytes = text.as_bytes();
        while let [byte, rest @ ..] = bytes {
            self.text[self.len] = *byte;
            self.len += 1;
            bytes = rest;
        }
        self
    }

    /// Adds the address of an object.
    #[must_use]
    pub const fn object(self, index: u16, sub_index: u8) -> Self {
        self.digits(index as usize, 16, 4).text("h sub-index ").number(sub_index as usize)
    }

    /// Adds a number.
    #[must_use]
    pub const fn number(self, number: usize) -> Self {
        self.digits(number, 10, 1)
    }

    /// Adds a code of four hexadecimal digits.
    #[must_use]
    pub const fn hexadecimal(self, code: u16) -> Self {
        self.digits(code as usize, 16, 4)
    }

    const fn digits(self, number: usize, base: usize, at_least: usize) -> Self {
        let before = if number < base && at_least <= 1 {
            self
        } else {
            self.digits(number / base, base, at_least.saturating_sub(1))
        };
        let (digit, _) = "0123456789ABCDEF".split_at(number % base + 1);
        before.text(digit.split_at(number % base).1)
    }

    /// Ends the build with the message.
    pub const fn raise(&self) -> ! {
        match str::from_utf8(self.text.split_at(self.len).0) {
            Ok(message) => panic!("{}", message),
            Err(_) => panic!("an object or a PDO is declared wrongly"),
        }
    }
}
