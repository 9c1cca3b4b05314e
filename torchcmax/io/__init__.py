"""Recordings in and out of files: `open` reads every form we know, `save` writes our own."""

from torchcmax.io.errors import DataError, DataNote, DataWarning
from torchcmax.io.events import Events
from torchcmax.io.hdf5 import save
from torchcmax.io.opening import OpenOptions, open
from torchcmax.io.overview import Summary, summary
from torchcmax.io.recording import Recording
from torchcmax.io.stream import Stream

__all__ = ["DataError", "DataNote", "DataWarning", "Events", "OpenOptions", "Recording", "Stream", "Summary", "open", "save", "summary"]
