//! What a slave is to be: the configuration of the slave in LSS configuration state, and the whole way to it.

use lss_slave::{
    BitRateSetting, NodeId,
    lss::{Address, Request},
};

use crate::{Error, Fastscan, Outcome, Procedure, SelectAlone, Step};

/// Makes a node-ID and a bit rate pending and stores them, in the slaves in LSS configuration state.
#[derive(Clone, Copy, Debug)]
pub struct Configure {
    node_id: Option<NodeId>,
    bit_rate: Option<BitRateSetting>,
    /// The request that was sent last.
    last: Request,
}

impl Configure {
    /// This node-ID; `None`: not configured.
    pub const fn node_id(node_id: Option<NodeId>) -> Self {
        Self { node_id, bit_rate: None, last: Request::StoreConfiguration }
    }

    /// This bit rate, too.
    #[must_use]
    pub const fn with_bit_rate(self, bit_rate: BitRateSetting) -> Self {
        Self { bit_rate: Some(bit_rate), ..self }
    }

    fn ask(&mut self, request: Request) -> Step<()> {
        self.last = request;
        Step::ask(request)
    }
}

impl Procedure for Configure {
    type Output = ();

    fn begin(&mut self) -> Step<()> {
        self.ask(Request::ConfigureNodeId(NodeId::to_lss(self.node_id)))
    }

    fn next(&mut self, outcome: Outcome) -> Step<()> {
        if let Err(error) = outcome {
            return Step::Done(Err(error));
        }
        match (self.last, self.bit_rate) {
            (Request::StoreConfiguration, _) => Step::Done(Ok(())),
            (Request::ConfigureNodeId(_), Some(rate)) => {
                self.ask(Request::ConfigureBitTiming { table: 0, index: rate.index() })
            }
            _ => self.ask(Request::StoreConfiguration),
        }
    }
}

/// Finds a slave, configures it and stores that. In the end all slaves are in LSS waiting state, also after an error. A
/// slave that had no node-ID boots up with the new one.
///
/// The result is the slave's LSS address; `None`: Fastscan finds no more slave.
#[derive(Clone, Debug)]
pub struct Assign {
    target: Target,
    configure: Configure,
    result: Result<Option<Address>, Error>,
    state: State,
}

#[derive(Clone, Debug)]
enum Target {
    Address(Address, SelectAlone),
    Scan(Fastscan),
}

/// What was begun last.
#[derive(Clone, Copy, Debug)]
enum State {
    Find,
    Configure,
    SwitchToWaiting,
}

impl Assign {
    /// For the slave with this LSS address, with or without a node-ID.
    pub const fn address(address: Address, configure: Configure) -> Self {
        Self::new(Target::Address(address, SelectAlone::new(address)), configure)
    }

    /// For a slave without a node-ID.
    pub const fn scan(scan: Fastscan, configure: Configure) -> Self {
        Self::new(Target::Scan(scan), configure)
    }

    const fn new(target: Target, configure: Configure) -> Self {
        Self { target, configure, result: Ok(None), state: State::Find }
    }

    fn after_find(&mut self, step: Step<Option<Address>>) -> Step<Option<Address>> {
        match step {
            Step::Done(Ok(Some(address))) => {
                self.result = Ok(Some(address));
                self.state = State::Configure;
                let step = self.configure.begin();
                self.after_configure(step)
            }
            Step::Done(result) => {
                self.result = result;
                self.leave()
            }
            step => step,
        }
    }

    fn after_configure(&mut self, step: Step<()>) -> Step<Option<Address>> {
        step.or_end(|result| {
            if let Err(error) = result {
                self.result = Err(error);
            }
            self.leave()
        })
    }

    fn leave(&mut self) -> Step<Option<Address>> {
        self.state = State::SwitchToWaiting;
        Step::ask(Request::SwitchToWaiting)
    }
}

/// The step of a selection, which ends with this address.
fn found(step: Step<()>, address: Address) -> Step<Option<Address>> {
    step.or_end(|result| Step::Done(result.map(|()| Some(address))))
}

impl Procedure for Assign {
    type Output = Option<Address>;

    fn begin(&mut self) -> Step<Self::Output> {
        self.state = State::Find;
        let step = match &mut self.target {
            Target::Address(address, select) => found(select.begin(), *address),
            Target::Scan(scan) => scan.begin(),
        };
        self.after_find(step)
    }

    fn next(&mut self, outcome: Outcome) -> Step<Self::Output> {
        match self.state {
            State::Find => {
                let step = match &mut self.target {
                    Target::Address(address, select) => found(select.next(outcome), *address),
                    Target::Scan(scan) => scan.next(outcome),
                };
                self.after_find(step)
            }
            State::Configure => {
                let step = self.configure.next(outcome);
                self.after_configure(step)
            }
            State::SwitchToWaiting => Step::Done(self.result),
        }
    }
}
