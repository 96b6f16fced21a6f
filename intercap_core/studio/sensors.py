"""Sensors of a device: the depth camera with noise, bias, flying pixels and holes; the microphone.

Magnitudes of depth after the Azure Kinect's published behaviour (Tolgyessy et al. 2021, "Evaluation
of the Azure Kinect and its comparison to Kinect V1 and V2"): about 1 mm at 1 m, 10 mm at 4 m."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy import signal

from intercap_core.geometry.camera.intrinsics import Intrinsics
from intercap_core.geometry.camera.rig import stereo_depth_noise
from intercap_core.geometry.camera.transforms import invert
from intercap_core.studio.capture_folder import SOUND_RATE as RATE
from intercap_core.studio.noise import NoiseSource, gaussian
from intercap_core.studio.render import Cast, RoomView
from intercap_core.studio.stage import StudioStage

# Nearest and farthest distance of a depth mode, metres, slightly beyond the data sheet's, and its
# noise relative to that of the first mode
LIMITS = {
    "NFOV_UNBINNED": (0.45, 4.3, 1.0),
    "NFOV_2X2BINNED": (0.45, 6.0, 0.7),
    "WFOV_2X2BINNED": (0.23, 3.2, 1.2),
    "WFOV_UNBINNED": (0.23, 2.5, 2.0),
}


STEREO_BASELINE_M = 0.050  # of a RealSense D435 (data sheet of the D400 series)


@dataclass(frozen=True)
class LargeErrors:
    """Systematic errors of a depth camera as large as the Azure Kinect's data sheet allows.

    The data sheet states less than 11 mm + 0.1 % of the distance; Tolgyessy et al. 2021 measured
    less than 11 mm up to 3.5 m. No measurement of the dependence on incidence was found: light that
    takes detours makes grazing surfaces appear farther away, here by 4 mm at 60 degrees.
    """

    bias_m: float
    """Error at 2.5 m, the radius of the ring, metres."""
    slope: float
    """Growth with distance."""
    grazing_m = 0.008  # times 1 - cosine of the incidence
    # Up to two pixels from a step, the light of two surfaces mixes; most of them are invalid. The
    # step is more than the slope of a floor. A finger away from other surfaces is all step.
    edge_m, edge_px, flying, lost_at_edge = 0.06, 2, 0.10, 0.85

    @classmethod
    def draw(cls, noise: NoiseSource, cameras: int) -> list[LargeErrors]:
        """Errors of all cameras. In every other recording, the master's bias is the largest."""
        rng = noise.rng("large depth errors")
        bias = np.clip(rng.normal(0, 0.005, cameras), -0.011, 0.011)
        if rng.random() < 0.5:
            worst = int(np.argmax(abs(bias)))
            bias[[0, worst]] = bias[[worst, 0]]
        slope = rng.normal(0, 0.001, cameras)
        return [cls(float(b), float(k)) for b, k in np.stack([bias, slope], 1) * noise.scale]

    def at(self, depth: np.ndarray, cosine: np.ndarray) -> np.ndarray:
        """Error (H, W) of pixels with this depth and cosine of incidence, metres."""
        return self.bias_m + self.slope * (depth - 2.5) + self.grazing_m * (1 - abs(cosine))


class DepthSensor:
    """One depth camera that looks at the room through ``view``."""

    noise_m = 0.0006  # standard deviation of depth at distance 0, metres
    noise_per_m2 = 0.00058  # growth of the standard deviation with squared distance
    smooth_share = 0.45  # share of the noise's variance that neighbouring pixels have in common
    bias_m = 0.003  # standard deviation of a camera's constant error, metres
    ripple_m = 0.0012  # amplitude of the error that oscillates with distance, metres
    ripple_period_m = 0.75  # its period, metres
    edge_m = 0.04  # step in depth that makes flying pixels, metres
    edge_px = 1  # reach of its effects, pixels
    flying = 0.35  # share of flying pixels on a step
    lost_at_edge = 0.30  # share of invalid pixels on a step
    grazing_cosine = 0.16  # surfaces below this cosine of incidence get holes
    dark = 0.10  # surfaces below this albedo get holes

    def __init__(
        self,
        view: RoomView,
        noise: NoiseSource,
        name: str,
        mode: str = "NFOV_UNBINNED",
        large: LargeErrors | None = None,
        stereo: bool = False,
    ) -> None:
        self._noise, self._limits = noise, LIMITS[mode]
        rng = noise.rng("depth", name)
        self._rng = rng
        self.bias = float(noise.tails(rng.normal(size=1))[0]) * self.bias_m * noise.scale
        self._large = large
        if stereo:
            self.noise_m, self.noise_per_m2 = 0.0, stereo_depth_noise(view.lens, STEREO_BASELINE_M)
        if large is not None:
            self.bias = large.bias_m
            self.edge_m, self.edge_px = large.edge_m, large.edge_px
            self.flying, self.lost_at_edge = large.flying, large.lost_at_edge
        self._ripple = rng.uniform(0, 2 * np.pi)
        self._in_field = _field(view.lens, mode)
        self.look_through(view)

    def look_through(self, view: RoomView) -> None:
        """Measure the room of ``view`` from now on; the camera and its errors stay the same."""
        self.view = view
        direction = view.directions()
        self._direction = direction / np.maximum(
            np.linalg.norm(direction, axis=-1, keepdims=True), 1e-9
        )
        self._finite = np.isfinite(view.depth)
        self._room = np.where(self._finite, view.depth, 0)
        self._cosine = np.einsum("hwc,hwc->hw", view.normal, self._direction)
        risk = self._risk(view.depth, self._cosine, np.ones_like(view.depth))
        blotches = _blotches(self._rng, view.depth.shape, 2.0, 0.28)
        self._static_holes = blotches < np.where(np.isfinite(risk), risk, 1)

    def _risk(self, depth: np.ndarray, cosine: np.ndarray, albedo: np.ndarray) -> np.ndarray:
        """Threshold (...) of :func:`_blotches` below which a pixel is a hole.

        It grows as surfaces become more grazing, or darker and farther away.
        """
        scale = self._noise.scale
        risk = 0.9 * np.clip(1 - np.abs(cosine) / (self.grazing_cosine * (0.5 + 0.5 * scale)), 0, 1)
        risk += np.clip(1 - albedo / self.dark, 0, 1) * np.clip(depth / 4 - 0.2, 0, 0.7)
        return risk * min(scale, 1.5)

    def image(self, cast: Cast) -> np.ndarray:
        """Depth (H, W) uint16 mm, 0 = invalid, of the room with moving surfaces.

        The error is noise with the deviation noise_m + noise_per_m2 z^2, a part of it correlated
        over 3 x 3 pixels; a ripple over distance; and the camera's bias.
        """
        rng, scale = self._rng, np.float32(self._noise.scale)
        depth, invalid = self._room.copy(), ~self._finite | ~self._in_field | self._static_holes
        incidence = self._cosine.copy()
        if len(cast.pixels):
            at = cast.image_pixels
            depth[at] = cast.depth
            cosine = np.einsum("nc,nc->n", cast.normal, self._direction[at])
            incidence[at] = cosine
            risk = self._risk(cast.depth, cosine, cast.colour.mean(-1))
            blotches = _blotches(rng, cast.identity.shape, 1.2, 0.45).ravel()[cast.pixels]
            invalid[at] = ~self._in_field[at] | (blotches < risk)
        self._edges(depth, invalid, scale)
        white, error = gaussian(rng, depth.shape), gaussian(rng, depth.shape)
        error *= np.float32(np.sqrt(1 - self.smooth_share))
        kernel = cv2.getGaussianKernel(3, 0.9)
        unit = np.sqrt(self.smooth_share) / np.linalg.norm(kernel @ kernel.T)
        error += cv2.GaussianBlur(white, (3, 3), 0.9) * np.float32(unit)
        if self._noise.family == "b":  # heavy tails
            error *= np.where(np.abs(white) > 2.2, np.float32(3.0), np.float32(0.85))
        sigma = depth * depth
        sigma *= np.float32(self.noise_per_m2)
        sigma += np.float32(self.noise_m)
        error *= sigma
        near, far, mode_noise = self._limits
        error *= np.float32(mode_noise)
        phase = depth * np.float32(2 * np.pi / self.ripple_period_m) + np.float32(self._ripple)
        error += np.float32(self.ripple_m) * np.sin(phase)
        error *= scale
        error += depth  # from here on the measured depth
        if self._large is None:
            error += np.float32(self.bias)
        else:
            error += self._large.at(depth, incidence).astype(np.float32)
        invalid |= (error <= near) | (error >= far)
        error[invalid] = 0
        return np.rint(error * 1000).astype(np.uint16)

    def _edges(self, depth: np.ndarray, invalid: np.ndarray, scale: np.float32) -> None:
        """Make some pixels at steps in depth flying pixels or invalid, in place.

        A flying pixel has a depth between both sides of the step.
        """
        kernel = np.ones((3, 3), np.uint8)
        near, far = cv2.erode(depth, kernel), cv2.dilate(depth, kernel)
        step = (far - near > self.edge_m).astype(np.uint8)
        reached = cv2.dilate(step, kernel, iterations=self.edge_px - 1)
        at = np.flatnonzero((reached > 0) & (near > 0))
        near, far = near.ravel(), far.ravel()
        chance, share = self._rng.random((2, len(at)), np.float32)
        strength = min(float(scale), 1.5)
        flying = chance < self.flying * strength
        gone = ~flying & (chance < (self.flying + self.lost_at_edge) * strength)
        invalid.ravel()[at[gone]] = True
        at, share = at[flying], share[flying]
        here = depth.ravel()[at]
        towards = np.where(here - near[at] < far[at] - here, 1, -1)
        depth.ravel()[at] = here + share * (far[at] - near[at]) * towards


def _blotches(
    rng: np.random.Generator, shape: tuple[int, ...], size: float, contrast: float
) -> np.ndarray:
    """Smooth random values in [0, 1] (H, W) that change over ``size`` pixels.

    ``contrast``: about twice the standard deviation of the blurred noise, which keeps most values
    within 0.5 +- 0.3.
    """
    smooth = cv2.GaussianBlur(gaussian(rng, shape), (0, 0), size)
    return 0.5 + 0.5 * np.tanh(smooth / contrast / 1.2)


def _field(lens: Intrinsics, mode: str) -> np.ndarray:
    """Mask (H, W) of pixels that the infrared light reaches.

    In narrow modes the corners of the image are dark, in wide modes everything outside a disc.
    """
    v, u = np.mgrid[: lens.height, : lens.width]
    x, y = u / (lens.width - 1) * 2 - 1, v / (lens.height - 1) * 2 - 1
    lit = abs(x) + 0.55 * abs(y) < 1.42 if mode.startswith("NFOV") else np.hypot(x, y) < 1
    return lit & np.isfinite(lens.rays[..., 0])


MAX_LATENCY_S = 0.04  # of a device's sound relative to its images
BEFORE_S = 3.0  # sounds start before the first set and end after the last
REVERBERATION_S = (0.25, 0.6)  # time of a fall by 60 dB, in furnished and in bare rooms


@dataclass(frozen=True)
class _Event:
    """One sound: start, seconds since the first set; samples (N,); source (3,), stage frame."""

    time_s: float
    samples: np.ndarray
    place: np.ndarray


def heard(stage: StudioStage, index: int, first_s: float, seconds: float) -> np.ndarray:
    """Samples (N,) float32 at :data:`.SOUND_RATE` of camera ``index``, as its file carries them.

    Args:
        first_s: true time of the first sample.
        seconds: duration.
    """
    rng = stage.noise.rng("microphone", stage.rig.true.names[index])
    eye = (invert(stage.rig.master_from_stage) @ stage.rig.true[index].master_from_colour)[:3, 3]
    latency = rng.uniform(-MAX_LATENCY_S, MAX_LATENCY_S) * min(1.0, stage.noise.scale)
    count = round(seconds * RATE)
    lead = round(max(REVERBERATION_S) * RATE)  # reverberation of earlier sounds
    direct = np.zeros(lead + count)
    for event in _events(stage):
        far = max(0.3, float(np.linalg.norm(event.place - eye)))
        travel = far / 343.0  # m/s, speed of sound at 20 °C
        start = lead + round((event.time_s + travel + latency - first_s) * RATE)
        there = slice(max(0, start), max(0, min(len(direct), start + len(event.samples))))
        if there.start < there.stop:
            direct[there] += event.samples[there.start - start : there.stop - start] / far
    sound = signal.fftconvolve(direct, _room(stage, rng))[lead : lead + count]
    power = float((sound**2).mean())
    noise = np.sqrt(power * 10 ** (-rng.uniform(5.0, 20.0) / 10)) if power > 0 else 1e-4  # SNR, dB
    sound += rng.normal(0, noise, count)
    return (0.5 * sound / max(np.abs(sound).max(initial=0.0), 1e-9)).astype(np.float32)


def _room(stage: StudioStage, rng: np.random.Generator) -> np.ndarray:
    """Impulse response of the room between this device and a person in the middle."""
    fall = stage.noise.rng("reverberation").uniform(*REVERBERATION_S)
    times = np.arange(round(fall * RATE)) / RATE
    tail = rng.normal(size=len(times)) * 10 ** (-3 * times / fall)
    tail[: round(0.002 * RATE)] = 0
    tail *= np.sqrt(rng.uniform(0.5, 1.2) / (tail**2).sum())  # energy relative to the direct sound
    tail[0] = 1.0
    return tail


def _events(stage: StudioStage) -> list[_Event]:
    """Sounds of the capture, equal for all cameras: steps below the person, syllables at the
    mouth."""
    rng = stage.noise.rng("sound")
    _, pelvis, _ = stage.play(stage.set_times)

    def person(time_s: float) -> np.ndarray:
        return np.array([np.interp(time_s, stage.set_times, axis) for axis in pelvis.T])

    events, end = [], stage.duration + BEFORE_S
    time_s = -BEFORE_S
    while (time_s := time_s + rng.uniform(0.4, 0.8)) < end:
        count = round(0.05 * RATE)
        burst = rng.normal(size=count) * np.exp(-np.arange(count) / (0.2 * count))
        events.append(
            _Event(time_s, rng.uniform(0.3, 1.0) * burst, person(time_s) * np.array([1, 1, 0]))
        )
    voice = signal.butter(2, (250.0, 3000.0), "bandpass", fs=RATE, output="sos")
    time_s = -BEFORE_S
    while (time_s := time_s + rng.uniform(0.15, 0.6)) < end:
        count = round(rng.uniform(0.08, 0.25) * RATE)
        syllable = signal.sosfilt(voice, rng.normal(size=count)) * np.hanning(count)
        mouth = person(time_s) + np.array([0, 0, 0.6])  # above the pelvis
        events.append(_Event(time_s, rng.uniform(0.3, 1.0) * syllable, mouth))
    return events
