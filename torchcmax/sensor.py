"""The sensor of a simulated event camera: from the light at its pixels, frame by frame, to events."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

NEVER = 2**62  # µs
Stream = tuple[np.ndarray, np.ndarray, np.ndarray]  # t [M] int64 µs | pixel [M] | polarity [M] uint8, 1 = brighter


@dataclass(frozen=True)
class Response:
    """What the pixels of a sensor are like."""

    threshold: float  # log intensity
    mismatch: float  # log intensity: standard deviation of the thresholds
    noise: float  # Hz per pixel
    refractory: float  # ms
    bandwidth: float  # Hz; 0 for no low-pass


class Sensor:
    """Pixels of an event camera, flat [N]: what each remembers between frames.

    A pixel compares its low-passed log intensity with the level of its last event.  Noise events do not touch that level: they
    only start the refractory time.
    """

    def __init__(self, response: Response, seed: int, light: np.ndarray) -> None:
        """A sensor that has been looking at the light, [N] float32 log intensity."""
        self.response, count = response, len(light)
        self.rng = np.random.default_rng([seed, 2])
        spread = self.rng.normal(response.threshold, response.mismatch, (2, count)).clip(response.threshold / 4)
        self.on, self.off = spread.astype(np.float32)
        phase = self.rng.uniform(-0.99, 0.99, count).astype(np.float32)
        self.memory = light + phase * np.where(phase > 0, self.off, self.on)
        self.light = self.level = light  # at the last frame, before and after the low-pass
        self.ready = np.full(count, -NEVER)  # µs from which on the pixel sees again
        self.blind = math.ceil(response.refractory * 1000)

    def step(self, light: np.ndarray, start: int, end: int) -> Stream:
        """The events between two frames, in order of time: light [N] log intensity at the end | start, end µs."""
        level = self._low_passed(light, (end - start) * 1e-6)
        t, pixel, p = self._events(level, start, end)
        self.light, self.level = light, level
        order = np.argsort(t, kind="stable")
        return t[order], pixel[order], p[order]

    def _low_passed(self, light: np.ndarray, dt: float) -> np.ndarray:
        """First-order low-pass, exact for light that changes linearly between the frames."""
        if not self.response.bandwidth:
            return light
        tau = 1 / (2 * math.pi * self.response.bandwidth)
        decay = math.exp(-dt / tau)
        lag = (light - self.light) * np.float32(tau / dt)
        out: np.ndarray = light - lag + (self.level - self.light + lag) * np.float32(decay)
        return out

    def _noise(self, start: int, end: int) -> Stream:
        """Poisson noise of all pixels, seen or not, sorted by pixel and time."""
        count = self.rng.poisson(self.response.noise * len(self.level) * (end - start) * 1e-6)
        pixel, t = self.rng.integers(0, len(self.level), count), self.rng.integers(start, end, count)
        p = self.rng.integers(0, 2, count, dtype=np.uint8)
        order = np.lexsort([t, pixel])
        return t[order], pixel[order], p[order]

    def _events(self, level: np.ndarray, start: int, end: int) -> Stream:
        """Noise and threshold crossings of every pixel in its order of time, the pixels' first, second, .. ones in turn.

        Each event blinds its pixel for the refractory time, so the next is looked for after it only.
        """
        t_noise, where, p_noise = self._noise(start, end)
        swing = np.stack([self.level, level]) - self.memory
        awake = (swing.max(0) >= self.on) | (swing.min(0) <= -self.off)
        awake[where] = True
        pixel = np.flatnonzero(awake)
        here, stop = np.searchsorted(where, pixel), np.searchsorted(where, pixel, "right")  # each pixel's noise that is still to come
        t_noise, p_noise = np.append(t_noise, NEVER), np.append(p_noise, np.uint8(0))
        parts: list[Stream] = [(t_noise[:0], where[:0], p_noise[:0])]
        while len(pixel):
            t_cross, target = self._crossing(pixel, level, start, end)
            noise = np.where(here < stop, t_noise[here], NEVER)
            unseen = noise < self.ready[pixel]
            noisy, crossed = ~unseen & (noise < NEVER) & (noise <= t_cross), ~unseen & (t_cross < noise)
            fired, t = noisy | crossed, np.minimum(noise, t_cross)
            p = np.where(noisy, p_noise[here], target > 0).astype(np.uint8)
            parts.append((t[fired], pixel[fired], p[fired]))
            self.memory[pixel[crossed]] += target[crossed]
            self.ready[pixel[fired]] = t[fired] + self.blind
            here = here + (unseen | noisy)
            more = unseen | fired
            pixel, here, stop = pixel[more], here[more], stop[more]
        t, pixel, p = (np.concatenate(column) for column in zip(*parts, strict=True))
        return t, pixel, p

    def _crossing(self, pixel: np.ndarray, level: np.ndarray, start: int, end: int) -> tuple[np.ndarray, np.ndarray]:
        """The next threshold crossing on the straight line from the last level to this one: pixel [K] -> t [K] µs, change of level [K].

        A pixel that is blind when it crosses makes its event as soon as it sees, if it is still beyond the threshold then.
        t is NEVER where there is none.
        """
        memory, on, off, slope = self.memory[pixel], self.on[pixel], self.off[pixel], (level - self.level)[pixel] / (end - start)
        begin = np.maximum(self.ready[pixel], start)
        now, last = self.level[pixel] + slope * (begin - start) - memory, level[pixel] - memory
        early = (now >= on) | (now <= -off)
        fire = (early | (last >= on) | (last <= -off)) & (begin <= end)
        target = np.where((now >= on) | (~early & (last >= on)), on, -off)
        late = fire & ~early  # these have a slope
        t = np.where(fire, begin, NEVER)
        wait = ((target - now)[late] / slope[late]).astype(np.int64)
        t[late] = np.minimum(begin[late] + wait, end)
        return t, target
