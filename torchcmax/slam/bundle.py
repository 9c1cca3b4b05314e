"""Joint optimization of a panorama's keyframes: each finds its place in the image of the others, and all follow one another."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchcmax import kernels
from torchcmax.core import so3
from torchcmax.core.match import Matching, match, units
from torchcmax.core.state import SIZE
from torchcmax.slam.globe import Facet, Globe
from torchcmax.slam.map import Area
from torchcmax.slam.mapper import WORSE, before, met
from torchcmax.slam.tracker import basis_of

JUDGES = 6  # keyframes that say whether a round has made the map better
STEADY = 0.02  # share of its information by which a keyframe stays where it is
TURN, RATE = slice(0, 3), slice(6, 9)  # of a state's numbers


@dataclass(frozen=True)
class Wish:
    """Where a keyframe wants to be, given the others: turn [3] rad and change of angular velocity [3] rad/s in its camera's frame.

    information [3, 3] about the turn, per rad^2, whatever the angular velocity | met: the mean strength of the others that
    its events meet, where it was asked
    """

    turn: Tensor
    rate: Tensor
    information: Tensor
    met: float = 0.0


def settled(globe: Globe, matching: Matching, last: int | None = None) -> Globe:
    """One round: the last keyframes, or all, find their places in the image of all others; the first one stays, and with it the world.

    The image that a keyframe is matched to goes with those who drew it.  A keyframe i wants to be turned by z_i against the mean of its
    neighbours j, which see the same with weights w_ij: (theta_i - sum_j w_ij theta_j - z_i)^T A_i (...) -> min over all turns
    theta at once.  So what a closed circle is off is spread over the keyframes around, and from round to round over all of it.
    Where keyframes then find less in the image of the others than before, the old map stays.
    """
    count = len(globe.keyframes)
    free = range(max(0, count - (last or count)), count)
    if count < 2:
        return globe
    matching = replace(matching, objective="lookup")
    judges = [count - 1] if last else list(free)[:: max(1, len(free) // JUDGES)]
    wishes = wanted(globe, list(free), matching, judges)
    if not wishes:
        return globe
    turns = held(globe, together(globe, wishes))
    keyframes = list(globe.keyframes)
    for i, wish in wishes.items():
        if i == 0:
            continue
        step = torch.zeros(1, SIZE, dtype=torch.float64)
        step[0, TURN], step[0, RATE] = turns[i], wish.rate
        keyframes[i] = keyframes[i].at(keyframes[i].state.moved(step))
    fresh = Globe(globe.focal, globe.border, globe.texture, number=globe.number)
    fresh.draw(keyframes)
    agreed_before = sum(wishes[i].met for i in judges if i in wishes) / len(judges)
    if agreed(fresh, judges, matching, globe.typical()) < WORSE * agreed_before:
        return globe
    return fresh


def held(globe: Globe, turns: dict[int, Tensor]) -> dict[int, Tensor]:
    """The same turns [3] rad with all that were turned back so that the first keyframe, if it was, stays, and with it the world.

    Its wish counts as the others' do; else they would all turn away from it, round by round.
    """
    if 0 not in turns:
        return turns
    R = [globe.keyframes[i].state.pose.R[0] for i in range(len(globe.keyframes))]
    back = (R[0] @ so3.exp(turns[0]) @ R[0].mT).mT
    return {i: so3.log(R[i].mT @ back @ R[i] @ so3.exp(turn)) if i else torch.zeros_like(turn) for i, turn in turns.items()}


def among_others(globe: Globe, number: int, typical: float) -> tuple[Facet, Area, Tensor] | None:
    """The plane before a keyframe, what all others drew there, and its warp H_k [K, 3, 3]; typical: the rate of an edge."""
    keyframe = globe.keyframes[number]
    facet = globe.facing(keyframe.state.pose)
    H_k = facet.warp(keyframe.state, keyframe.seconds)
    box = facet.box(H_k)
    if box is None:
        return None
    layers = facet.of(globe.layers - globe.layers_of([keyframe]), box)
    return facet, Area(box, layers, facet.charts(layers, box, facet.texture.blur[-1:], typical)), H_k


def agreed(globe: Globe, numbers: list[int], matching: Matching, typical: float) -> float:
    """What these keyframes meet in the image of the others, in the mean."""

    def of(number: int) -> float:
        found = among_others(globe, number, typical)
        return 0.0 if found is None else met(found[0], globe.keyframes[number], *found[1:], matching)

    with ThreadPoolExecutor(kernels.threads()) as pool:
        return sum(pool.map(of, numbers)) / len(numbers)


def wanted(globe: Globe, numbers: list[int], matching: Matching, judges: list[int]) -> dict[int, Wish]:
    """What keyframes want, and, of the judges, what they meet."""
    typical = globe.typical()
    with ThreadPoolExecutor(kernels.threads()) as pool:
        wishes = list(pool.map(lambda i: _wish(globe, i, typical, matching, i in judges), numbers))
    return {i: wish for i, wish in zip(numbers, wishes, strict=True) if wish is not None}


def _wish(globe: Globe, number: int, typical: float, matching: Matching, asked: bool) -> Wish | None:
    found, keyframe = among_others(globe, number, typical), globe.keyframes[number]
    if found is None:
        return None
    facet = found[0]
    task = before(facet, keyframe, *found[1:], matching, basis_of("rotation", "full"))
    if task is None:
        return None
    one = match(torch.zeros(1, 6, dtype=torch.float64), task, matching)
    size = units(keyframe.state, facet.plane, keyframe.seconds, facet.focal)[0]
    x, A = one.x[0] * size, (one.information + task.prior)[0] / (size[:, None] * size)
    turn = A[TURN, TURN] - A[TURN, RATE] @ torch.linalg.solve(A[RATE, RATE], A[RATE, TURN])
    return Wish(x[TURN], x[RATE], turn, met(facet, keyframe, *found[1:], matching) if asked else 0.0)


def together(globe: Globe, wishes: dict[int, Wish]) -> dict[int, Tensor]:
    """The turns of all keyframes, rad in their cameras' frames, that fulfil their wishes best, together; others stay."""
    numbers = sorted(wishes)
    R = torch.cat([k.state.pose.R for k in globe.keyframes])
    apart = (R[numbers, :, 2] @ R[:, :, 2].mT).clamp(-1, 1).arccos()
    weight = (1 - apart / globe.field_of_view).clamp_min(0).square()
    weight[range(len(numbers)), numbers] = 0
    weight = weight / weight.sum(1, keepdim=True).clamp_min(1e-9)
    own = torch.eye(len(numbers), dtype=torch.float64)
    root = torch.linalg.cholesky(torch.stack([wishes[i].information for i in numbers])).mT
    L = root @ R[numbers].mT  # of a turn in the world's frame
    wish, stay = (torch.einsum("iab,ij->iajb", L, D).flatten(2).flatten(0, 1) for D in (own - weight[:, numbers], STEADY**0.5 * own))
    z = (root @ torch.stack([wishes[i].turn for i in numbers])[..., None]).flatten()
    theta = torch.linalg.solve(wish.mT @ wish + stay.mT @ stay, wish.mT @ z).view(-1, 3)
    return {i: R[i].mT @ turn for i, turn in zip(numbers, theta, strict=True)}
