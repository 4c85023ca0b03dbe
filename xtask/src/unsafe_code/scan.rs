//! The unsafe code of a source file.

use crate::sources::Source;

/// A block, function, implementation, declaration or attribute with `unsafe`.
#[derive(Debug, PartialEq)]
pub struct Item {
    /// From 1 on.
    pub line: usize,
    /// As in the source: `unsafe {}`, `unsafe fn`, `unsafe impl`, `unsafe extern`, `#[unsafe(no_mangle)]`.
    pub kind: String,
    /// The function around it, or the item that it belongs to.
    pub owner: String,
    /// Empty if there is none.
    pub argument: String,
}

/// The unsafe code of `source`, in its order.
pub fn items(source: &Source) -> Vec<Item> {
    let code = source.code();
    let code: Vec<&str> = code.lines().collect();
    let text: Vec<&str> = source.text.lines().collect();
    let mut items = Vec::new();
    for (index, line) in code.iter().enumerate() {
        for (at, _) in line.match_indices("unsafe") {
            let is_of_word = |c: char| c.is_alphanumeric() || c == '_';
            let after = &line[at + "unsafe".len()..];
            if line[..at].ends_with(is_of_word) || after.starts_with(is_of_word) {
                continue;
            }
            let kind = kind(after.trim_start());
            items.push(Item {
                line: index + 1,
                owner: owner(&code, index, &kind),
                argument: argument(&text, &code, index),
                kind,
            });
        }
    }
    items
}

/// The kind of an item, where `after` follows the word `unsafe`.
fn kind(after: &str) -> String {
    if let Some(attribute) = after.strip_prefix('(') {
        let name = attribute.split([' ', '=', ')']).next().unwrap_or_default();
        return format!("#[unsafe({name})]");
    }
    let is_function = after.split_whitespace().any(|word| word == "fn");
    let kind = match after.split(|c: char| !c.is_alphanumeric()).next() {
        Some("impl") => "unsafe impl",
        Some("trait") => "unsafe trait",
        Some("fn" | "extern") if is_function => "unsafe fn",
        Some("extern") => "unsafe extern",
        _ => "unsafe {}",
    };
    kind.to_owned()
}

/// The item that the code in line `index` is, or to which it belongs; empty for a declaration of foreign items.
fn owner(code: &[&str], index: usize, kind: &str) -> String {
    let owner = match kind {
        "unsafe extern" => None,
        "unsafe {}" => code[..=index].iter().rev().find_map(|line| name(line)),
        _ => code[index..].iter().find_map(|line| name(line)),
    };
    owner.unwrap_or_default()
}

/// The name of the function or static, or the head of the implementation, that begins in `line`.
fn name(line: &str) -> Option<String> {
    let qualifiers = ["unsafe", "extern", "const", "async", "safe"];
    let is_qualifier = |word: &&str| word.starts_with("pub") || qualifiers.contains(word);
    let mut words = line.split_whitespace().skip_while(is_qualifier);
    let name = match words.next()? {
        "fn" => words.next()?,
        "static" => words.find(|word| *word != "mut")?,
        word if word.starts_with("impl") => {
            let head = line[line.find("impl")?..].trim_end_matches(['{', '}', ' ']);
            return Some(head.to_owned());
        }
        _ => return None,
    };
    Some(name.split(['(', '<', ':']).next().unwrap_or(name).to_owned())
}

/// The comment `// SAFETY: ...` above the statement or the attributes of line `index`, or the section `# Safety` of the
/// documentation there.
fn argument(text: &[&str], code: &[&str], index: usize) -> String {
    let mut comment = Vec::new();
    for above in (0..index).rev() {
        let line = text[above].trim();
        if let Some(words) = line.strip_prefix("//") {
            comment.push(words.trim_start_matches('/').trim());
            if let Some(start) = words.trim().strip_prefix("SAFETY:") {
                comment.pop();
                comment.push(start.trim());
            } else if words.trim() != "/ # Safety" {
                continue;
            } else {
                comment.pop();
            }
            comment.reverse();
            let mut argument = comment.join(" ").replace('|', "\\|");
            if let Some(first) = argument.get(..1) {
                argument.replace_range(..1, &first.to_uppercase());
            }
            return argument;
        }
        comment.clear();
        let code = code[above].trim();
        let is_attribute = code.starts_with("#[") && code.ends_with(']');
        if !is_attribute && (code.is_empty() || code.ends_with([';', '{', '}', ','])) {
            break;
        }
    }
    String::new()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn found(text: &str) -> Vec<[String; 3]> {
        let source = Source { path: "a.rs".to_owned(), text: text.to_owned() };
        items(&source).into_iter().map(|item| [item.kind, item.owner, item.argument]).collect()
    }

    #[test]
    fn each_kind_is_found_with_its_owner_and_its_argument() {
        let cases = [
            (
                "fn one() {\n    // SAFETY: it is\n    // aligned.\n    let a = unsafe { b() };\n}",
                ["unsafe {}", "one", "It is aligned."],
            ),
            (
                "pub fn two(a: u8) {\n    // SAFETY: any value.\n    a\n        .b()\n        .write(|w| unsafe {\n        });\n}",
                ["unsafe {}", "two", "Any value."],
            ),
            (
                "/// Reads.\n///\n/// # Safety\n/// `a` is valid.\n#[inline]\npub unsafe fn three(a: *const u8) {}",
                ["unsafe fn", "three", "`a` is valid."],
            ),
            (
                "// SAFETY: one thread.\nunsafe impl<T> Sync for Place<T> {}",
                ["unsafe impl", "impl<T> Sync for Place<T>", "One thread."],
            ),
            (
                "// SAFETY: the linker defines it.\nunsafe extern \"C\" {\n    static END: u8;\n}",
                ["unsafe extern", "", "The linker defines it."],
            ),
            (
                "/// Doc.\n// SAFETY: private.\n#[unsafe(link_section = \".a\")]\nstatic mut NOTE: u8 = 0;",
                ["#[unsafe(link_section)]", "NOTE", "Private."],
            ),
        ];
        for (text, expected) in cases {
            assert_eq!(found(text), [expected.map(str::to_owned)], "{text}");
        }
        let head = "// SAFETY: the only one.\n#[unsafe(naked)]\n#[unsafe(no_mangle)]\nunsafe extern \"C\" fn four() {}";
        let items = found(head);
        assert_eq!(items.len(), 3);
        assert!(
            items.iter().all(|[_, owner, argument]| owner == "four" && argument == "The only one.")
        );
    }

    #[test]
    fn an_argument_of_something_else_does_not_count() {
        for text in [
            "fn one() {\n    unsafe { a() }\n}",
            "fn one() {\n    // It is safe.\n    unsafe { a() }\n}",
            "fn one() {\n    // SAFETY: that one.\n    let a = 1;\n    unsafe { a() }\n}",
            "// SAFETY: the function.\nfn one() {\n    unsafe { a() }\n}",
            "// SAFETY: far.\n\nunsafe impl Sync for A {}",
        ] {
            assert_eq!(found(text)[0][2], "", "{text}");
        }
    }

    #[test]
    fn the_word_elsewhere_is_no_item() {
        let text = "#![forbid(unsafe_code)]\n// unsafe { a() }\nconst TEXT: &str = \"unsafe {}\";\nfn is_unsafe() {}";
        assert_eq!(found(text), [[""; 3]; 0]);
    }
}
