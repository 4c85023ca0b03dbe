//! Where a panic was: its file and its line, for the next start.
//!
//! The handler of panic-probe keeps them to itself, but they lie on the stack. Only in a program with the feature
//! `panic-message` the compiler leaves them in.

// SAFETY: the linker scripts define them; only their addresses are used.
unsafe extern "C" {
    /// The first byte of the constants, and the first one behind them.
    static __srodata: u8;
    static __erodata: u8;
    /// The first byte behind the stack.
    static _stack_start: u8;
}

/// Whether these bytes are constants of this program.
fn is_constant(start: u32, length: u32) -> bool {
    let constants = &raw const __srodata as u32..&raw const __erodata as u32;
    constants.contains(&start) && length <= constants.end - start
}

/// The line, and the name of the file, of the panic whose handler has faulted with this stack pointer: those of the first
/// [`Location`](core::panic::Location) that a word on the stack points to.
pub fn on_the_stack(sp: usize) -> Option<(u32, [u32; 2])> {
    /// The most words from the fault to the panic.
    const MOST: usize = 128;
    if !cfg!(feature = "panic-location") {
        return None;
    }
    let words = (sp..&raw const _stack_start as usize).step_by(4).take(MOST);
    // SAFETY: the words are aligned and belong to the stack above the fault.
    let mut words = words.map(|at| unsafe { (at as *const u32).read_volatile() });
    words.find_map(|word| {
        let may_be = word % 4 == 0 && is_constant(word, 12);
        // SAFETY: the three words are constants, which any content may be.
        let [start, length, line] = may_be.then(|| unsafe { (word as *const [u32; 3]).read() })?;
        text([start, length]).map(|_| (line, [start, length]))
    })
}

/// The name of the file. Another program may have left it.
pub fn file(file: [u32; 2]) -> &'static str {
    let file = if cfg!(feature = "panic-location") { text(file) } else { None };
    file.unwrap_or("unknown file")
}

/// The text at this address with this length, if it is the name of a source file among the constants of this program.
fn text([start, length]: [u32; 2]) -> Option<&'static str> {
    const MOST: u32 = 200;
    if length > MOST || !is_constant(start, length) {
        return None;
    }
    // SAFETY: the bytes are constants, which nothing changes.
    let bytes = unsafe { core::slice::from_raw_parts(start as *const u8, length as usize) };
    let is_name = bytes.ends_with(b".rs") && bytes.is_ascii();
    // SAFETY: ASCII is UTF-8.
    is_name.then(|| unsafe { core::str::from_utf8_unchecked(bytes) })
}
