"""The store: artefacts in folders that are named by what made them.

The store is the cache.  An artefact's key is the digest of its stage, its algorithm with every
option, the code that it rests on and the keys of its inputs: a Merkle chain that is known before
anything runs.  A folder is written as a draft and renamed whole; two runs that
race make the same thing, so nobody waits for a lock.  Deleting any folder is safe.
"""

from nlights_core.store.artefacts import RottenArtefactError, Store
from nlights_core.store.drafts import draft, sweep, sweep_below
from nlights_core.store.records import RECORD
from nlights_core.store.references import ArtefactRef, Work, describe
from nlights_core.store.whole_files import make_writable, write_whole

__all__ = [
    "RECORD",
    "ArtefactRef",
    "RottenArtefactError",
    "Store",
    "Work",
    "describe",
    "draft",
    "make_writable",
    "sweep",
    "sweep_below",
    "write_whole",
]
