"""Commands: what people type."""

from nlights_flows.commands.interrupts import heed_early

heed_early()  # here, since loading the rest takes long enough to be interrupted
