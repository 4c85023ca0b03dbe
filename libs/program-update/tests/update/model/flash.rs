//! The flash of the model: areas and words of the journal with what they may read.

use std::{cell::RefCell, collections::HashSet, rc::Rc};

use program_update::{Area as Place, Flash, FlashError, journal};

use super::{At, World};
use crate::program::{file, words};

const SECTORS: [u32; 2] = [576, 192];
const AREA: usize = 192;
const HEADER: usize = 128;
const JOURNAL: usize = journal::OFFSET as usize / 4;
/// The words of a program, which reaches into the second sector.
pub const PROGRAM: usize = 20;
const BLANK: u32 = u32::MAX;

/// The state of RUN or BACKUP without its journal.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Area {
    Blank,
    Damaged,
    /// A whole program.
    Firm(u8),
    /// It reads as this program, or damaged.
    Weak(u8),
}

/// What each word of the journal may read: bits of [`BLANK_WORD`], [`PARTIAL`], [`SET`] and [`VOID`].
#[derive(Clone, Copy, PartialEq, Eq, Hash)]
pub struct Journal([u8; journal::WORDS as usize]);

const BLANK_WORD: u8 = 1;
const PARTIAL: u8 = 2;
const SET: u8 = 4;
const VOID: u8 = 8;

const LOADED: usize = 2;
const BACK: [usize; 3] = [9, 11, 13];

impl Journal {
    pub fn blank() -> Self {
        Self([BLANK_WORD; _])
    }
}

impl std::fmt::Debug for Journal {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        for (i, word) in self.0.iter().enumerate().filter(|(_, word)| **word != BLANK_WORD) {
            let name = ["SAVED", "SAVED2", "LOADED", "TRY", "TRY2", "TRY3", "KEPT", "KEPT2"];
            let pair = ["UNDO", "BACK", "UNDO2", "BACK2", "UNDO3", "BACK3"];
            let name = name.iter().chain(&pair).nth(i).unwrap_or(&"");
            write!(f, "{name}=")?;
            for (bit, letter) in [(BLANK_WORD, 'B'), (PARTIAL, 'P'), (SET, 'S'), (VOID, 'Z')] {
                if word & bit != 0 {
                    write!(f, "{letter}")?;
                }
            }
            write!(f, " ")?;
        }
        Ok(())
    }
}

/// The choices of a run, which all runs together make in every way.
#[derive(Default)]
pub struct Choices {
    made: Vec<(usize, usize)>,
    next: usize,
}

impl Choices {
    pub fn choose(&mut self, of: usize) -> usize {
        if of < 2 {
            return 0;
        }
        if self.next == self.made.len() {
            self.made.push((0, of));
        }
        let (choice, was_of) = self.made[self.next];
        assert_eq!(was_of, of, "a run repeats itself up to its first new choice");
        self.next += 1;
        choice
    }

    /// Goes on to the next run; false after the last one.
    pub fn advance(&mut self) -> bool {
        self.next = 0;
        while let Some((choice, of)) = self.made.pop() {
            if choice + 1 < of {
                self.made.push((choice + 1, of));
                return true;
            }
        }
        false
    }
}

/// The content of an area in this run.
struct Content {
    state: Area,
    /// What the state was, and nothing was written since.
    is_untouched: bool,
    words: Option<Vec<u32>>,
}

/// The flash during one run; clones are handles.
#[derive(Clone)]
pub struct Chip(pub Rc<RefCell<Inner>>);

pub struct Inner {
    pub world: World,
    pub choices: Choices,
    /// The states after a cut.
    pub cut: Vec<(World, &'static str)>,
    seen: HashSet<World>,
    images: Rc<Vec<Vec<u32>>>,
    run: Content,
    backup: Content,
    read: [Option<u8>; journal::WORDS as usize],
    pub violation: Option<String>,
}

/// The words of an area with a program.
pub fn images(count: u8) -> Rc<Vec<Vec<u32>>> {
    let image = |number| {
        let mut image: Vec<_> = words(&file(number, PROGRAM)).collect();
        image.resize(AREA, BLANK);
        image
    };
    Rc::new((0..count).map(image).collect())
}

impl Chip {
    pub fn new(world: World, choices: Choices, images: Rc<Vec<Vec<u32>>>) -> Self {
        let content = |state| Content { state, is_untouched: true, words: None };
        Self(Rc::new(RefCell::new(Inner {
            run: content(world.run),
            backup: content(world.backup),
            world,
            choices,
            cut: Vec::new(),
            seen: HashSet::new(),
            images,
            read: [None; _],
            violation: None,
        })))
    }

    pub fn choose(&self, of: usize) -> usize {
        self.0.borrow_mut().choices.choose(of)
    }

    /// The state of the device now.
    pub fn world(&self) -> World {
        self.0.borrow().now()
    }

    pub fn change(&self, change: impl FnOnce(&mut World)) {
        change(&mut self.0.borrow_mut().world);
    }

    pub fn check(&self, holds: bool, what: &str) {
        self.0.borrow_mut().check(holds, what);
    }
}

impl Inner {
    fn check(&mut self, holds: bool, what: &str) {
        if !holds && self.violation.is_none() {
            self.violation = Some(format!("{what}: {:?}", self.now()));
        }
    }

    fn content(&mut self, place: Place) -> &mut Content {
        match place {
            Place::Run => &mut self.run,
            Place::Backup => &mut self.backup,
        }
    }

    /// The words of an area as they read in this run.
    fn words(&mut self, place: Place) -> &mut Vec<u32> {
        if self.content(place).words.is_none() {
            let damaged = |mut image: Vec<u32>| {
                image[HEADER + PROGRAM - 1] ^= 0x100;
                image
            };
            let state = self.content(place).state;
            let image = match state {
                Area::Blank => vec![BLANK; AREA],
                Area::Damaged => damaged(self.images[0].clone()),
                Area::Firm(k) => self.images[k as usize].clone(),
                Area::Weak(k) if self.choices.choose(2) == 0 => self.images[k as usize].clone(),
                Area::Weak(k) => damaged(self.images[k as usize].clone()),
            };
            self.content(place).words = Some(image);
        }
        self.content(place).words.as_mut().expect("just made")
    }

    fn state(&self, content: &Content) -> Area {
        match &content.words {
            Some(words) if !content.is_untouched => {
                if words.iter().all(|word| *word == BLANK) {
                    return Area::Blank;
                }
                let is_here = |image: &Vec<u32>| image == words;
                self.images.iter().position(is_here).map_or(Area::Damaged, |k| Area::Firm(k as u8))
            }
            _ => content.state,
        }
    }

    fn now(&self) -> World {
        let (run, backup) = (self.state(&self.run), self.state(&self.backup));
        World { run, backup, ..self.world }
    }

    fn cut(&mut self, world: World, why: &'static str) {
        if let Some(cuts) = world.cuts.checked_sub(1) {
            let world = World { cuts, at: At::Start { stop: false }, ..world };
            if self.seen.insert(world) {
                self.cut.push((world, why));
            }
        }
    }

    fn program_journal(&mut self, i: usize, word: u32) {
        let may = self.world.journal.0[i];
        let torn = match word {
            journal::SET if may == SET || may == VOID => may,
            journal::SET => may | PARTIAL | SET,
            _ => may | VOID,
        };
        if let (LOADED, Area::Firm(number)) = (i, self.now().run)
            && word == journal::SET
        {
            self.world.newest = number.max(self.world.newest);
        }
        // A torn word may read as before too.
        let mut world = self.now();
        world.journal.0[i] = torn;
        self.cut(world, "cut in a word of the journal");
        self.world.journal.0[i] = match word {
            journal::SET if may == VOID => VOID,
            journal::SET => SET | may & VOID,
            _ => VOID,
        };
        self.read[i] = None;
        let now = self.now();
        if word == journal::SET && BACK.contains(&i) {
            // A settled BACK changes nothing; a new one ends a restore.
            if let (Area::Firm(k), Area::Firm(run)) = (now.backup, now.run)
                && may & SET == 0
            {
                self.check(k == run, "a restore ends with another program");
            }
            if let Area::Firm(k) = now.backup
                && now.run == now.backup
            {
                (self.world.kept, self.world.maybe) = (k, k);
            }
        }
        // A copy of a program that may have been confirmed counts from now on.
        if word == journal::SET
            && i == 0
            && now.run == now.backup
            && now.run == Area::Firm(now.maybe)
        {
            self.world.kept = now.maybe;
        }
    }

    fn program(&mut self, place: Place, at: usize, word: u32) {
        let is_blank = self.words(place)[at] == BLANK;
        self.check(is_blank, "a word is programmed twice");
        let can_cut = self.world.cuts > 0;
        if can_cut {
            let before = self.now();
            self.cut(before, "cut before a word");
        }
        self.words(place)[at] &= word;
        self.content(place).is_untouched = false;
        if can_cut {
            let mut torn = self.now();
            let area = if place == Place::Run { &mut torn.run } else { &mut torn.backup };
            *area = if let Area::Firm(k) = *area { Area::Weak(k) } else { Area::Damaged };
            self.cut(torn, "cut in a word");
        }
    }

    /// A cut in the erase of the sector with the journal: each word may read as before, or blank. What certainly reads as
    /// one of them does nothing that this does not do as well.
    fn fade(&mut self, backup: Area) {
        let mut world = World { backup, ..self.now() };
        for word in world.journal.0.iter_mut() {
            *word |= BLANK_WORD;
        }
        self.cut(world, "cut in the erase of BACKUP");
    }
}

fn journal_word(place: Place, at: usize) -> Option<usize> {
    let i = at.checked_sub(JOURNAL)?;
    (place == Place::Backup && i < journal::WORDS as usize).then_some(i)
}

impl Flash for Chip {
    fn sectors(&self, _: Place) -> &'static [u32] {
        &SECTORS
    }

    fn read(&mut self, place: Place, offset: u32) -> u32 {
        let mut inner = self.0.borrow_mut();
        let at = offset as usize / 4;
        let Some(i) = journal_word(place, at) else { return inner.words(place)[at] };
        let read = match inner.read[i] {
            Some(read) => read,
            None => {
                let may = inner.world.journal.0[i];
                let bits: Vec<_> =
                    (0..4).map(|bit| 1 << bit).filter(|bit| may & bit != 0).collect();
                bits[inner.choices.choose(bits.len())]
            }
        };
        inner.read[i] = Some(read);
        match read {
            BLANK_WORD => BLANK,
            PARTIAL => journal::SET | 0x0100_0008,
            SET => journal::SET,
            _ => journal::VOID,
        }
    }

    fn program(&mut self, place: Place, offset: u32, words: &[u32]) -> Result<(), FlashError> {
        let mut inner = self.0.borrow_mut();
        for (word, at) in words.iter().zip(offset as usize / 4..) {
            match journal_word(place, at) {
                Some(i) => inner.program_journal(i, *word),
                None => inner.program(place, at, *word),
            }
        }
        Ok(())
    }

    fn erase(&mut self, place: Place, sector: usize) -> Result<(), FlashError> {
        let mut inner = self.0.borrow_mut();
        let now = inner.now();
        let area = if place == Place::Run { now.run } else { now.backup };
        let mut torn = vec![Area::Damaged, Area::Blank];
        if let Area::Firm(k) | Area::Weak(k) = area {
            torn.push(Area::Weak(k));
        }
        if place == Place::Run {
            let keeps = matches!(now.backup, Area::Firm(k) if k == now.kept || k == now.maybe);
            inner.check(keeps, "RUN is erased, BACKUP has no program that was confirmed");
        }
        for area in torn {
            match place {
                Place::Run => inner.cut(World { run: area, ..now }, "cut in the erase of RUN"),
                Place::Backup if sector == 0 => inner.fade(area),
                Place::Backup => inner.cut(World { backup: area, ..now }, "cut in an erase"),
            }
        }
        let from = SECTORS[..sector].iter().sum::<u32>() as usize / 4;
        let to = from + SECTORS[sector] as usize / 4;
        inner.words(place)[from..to].fill(BLANK);
        inner.content(place).is_untouched = false;
        if place == Place::Backup && sector == 0 {
            inner.world.journal = Journal::blank();
            inner.read = [None; _];
        }
        Ok(())
    }

    fn poll(&mut self) -> Option<Result<(), FlashError>> {
        Some(Ok(()))
    }
}
