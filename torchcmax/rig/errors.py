"""What can go wrong with a rig, each kind with the exit status of the command line."""

from __future__ import annotations


class RigError(Exception):
    """A rig that cannot go on: says what, where, and what to do.  `code` is the exit status."""

    code = 3


class Refused(RigError):
    """A configuration, a plan or a drive that is not as it must be; nothing moves."""

    code = 2


class DriveFault(RigError):
    """A drive went into its fault state, or the host's own limits were broken; all axes are stopped and disabled."""

    code = 3


class LinkLost(RigError):
    """A drive no longer answers, or the bus is gone."""

    code = 4


class Unanswered(LinkLost):
    """A drive leaves too much unanswered, though not all: it still does what it is told."""


class Aborted(RigError):
    """The user ended it."""

    code = 5


class Rejected(RigError):
    """The clocks could not be aligned well enough, so that there is no ground truth."""

    code = 6
