"""Named ways to judge a result, so that its numbers can stand beside those of a paper."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Align = Literal["similarity", "sim3", "se3", "pose", "rotation"]


@dataclass(frozen=True)
class Protocol:
    """What lays the estimate on the truth, and what is compared then; docs/evaluation.md says more.

    align: None where only velocities are compared, in the camera's frame | turning: orientations alone
    source: who measures so | evo: whether ATE and RPE are evo's
    """

    about: str
    source: str
    align: Align | None
    turning: bool = False

    @property
    def evo(self) -> bool:
        """Whether alignment or errors are evo's."""
        return self.align in ("sim3", "se3", "pose")


PROTOCOLS = {
    "similarity": Protocol(
        "one similarity, for which positions and orientations vote",
        "torchcmax; positions as Umeyama, PAMI 1991",
        "similarity",
    ),
    "rotation": Protocol(
        "orientations alone, after the one rotation that fits all best",
        "torchcmax; chordal mean as Hartley et al., Rotation Averaging, IJCV 2013",
        "rotation",
        turning=True,
    ),
    "sim3": Protocol(
        "ATE after Sim(3) of the positions, and RPE: a camera that cannot know its scale",
        "Zhang and Scaramuzza, IROS 2018; Klenk et al., DEVO, 3DV 2024",
        "sim3",
    ),
    "se3": Protocol(
        "ATE after SE(3) of the positions, and RPE: metres are judged too",
        "Sturm et al., IROS 2012",
        "se3",
    ),
    "first_pose": Protocol(
        "ATE with one pose laid on the truth's, the first or that at --align_at, and RPE: all drift counts",
        "evo, align_origin; Zhang and Scaramuzza, IROS 2018",
        "pose",
    ),
    "cmax_slam": Protocol(
        "absolute and relative rotation error with one pose laid on the truth's, the first or that at --align_at",
        "Guo and Gallego, CMax-SLAM, T-RO 2024; of the Event Camera Dataset their fig. 6 shows the first 30 s: --to 30",
        "pose",
        turning=True,
    ),
    "velocity": Protocol(
        "angular and linear velocity of every window in the camera's frame, nothing aligned",
        "angular: Gallego and Scaramuzza, Accurate Angular Velocity Estimation with an Event Camera, RA-L 2017",
        None,
    ),
}
