"""A user's ONNX model of images: its session, what it takes, and images made to fit it.

What a model does with the image is its caller's matter: segmentation here, keypoints elsewhere.
Nothing that a model file says is run as code; custom operators are not loaded.
"""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np

from intercap_core.errors import UserError
from intercap_core.inputs.files import check_file, printable

MAX_NETWORK_BYTES = 1 << 31  # limit of the ONNX format; larger models store weights in other files
MAX_INPUT_SIDE = 8192  # px; detectors use 640 to 1333
MAX_BATCH = 256  # images in one input
# Mean of ImageNet, blue first, as in Caffe's models; maskrcnn-benchmark subtracts it.
CAFFE_MEAN_BGR = np.array([102.9801, 115.9465, 122.7717], np.float32)
# Mean and standard deviation of ImageNet, red first; torchvision and mmpose normalise with them.
IMAGENET_MEAN_RGB = np.array([123.675, 116.28, 103.53], np.float32)
IMAGENET_DEVIATION_RGB = np.array([58.395, 57.12, 57.375], np.float32)
PixelValues = Literal["rgb", "bgr255", "bgr_mean", "imagenet"]

_TYPES = {"tensor(float)": np.float32, "tensor(float16)": np.float16, "tensor(uint8)": np.uint8}
_PROVIDERS = {"cpu": "CPUExecutionProvider", "cuda": "CUDAExecutionProvider"}

_TEXT = r"""'(?:[^'\\]|\\.)*'|"(?:[^"\\]|\\.)*\""""
_NAMED = re.compile(rf"""\s*["']?(\d{{1,9}})["']?\s*:\s*({_TEXT})\s*(?:,|$)""", re.DOTALL)
_LISTED = re.compile(rf"\s*({_TEXT})\s*(?:,|$)", re.DOTALL)


@dataclass(frozen=True)
class Fit:
    """Where an image lies in the model's input: input = image * scale + (left, top).

    ``scale`` (x, y) and the shift count pixel edges, so that a pixel's middle is at 0.5.
    """

    scale: tuple[float, float]
    left: int
    top: int
    size: tuple[int, int]  # of the image: width, height

    def to_image(self, boxes: np.ndarray) -> np.ndarray:
        """Boxes (N, 4) of two corners from the input to the image, within it."""
        shift, scale = (self.left, self.top) * 2, self.scale * 2
        corners = (boxes - np.array(shift, np.float32)) / np.array(scale, np.float32)
        return np.clip(corners, 0, np.array(self.size * 2, np.float32))


class OnnxModel:
    """An open session with one image as input. Obtained from :meth:`load`.

    ``size`` (width, height) that the model insists on, None = any; ``batch`` likewise.
    ``outputs`` are names, declared shapes (numbers, or names of free lengths) and types.
    ``metadata`` is what the exporter wrote into the file.
    """

    def __init__(self, path: Path, session: Any) -> None:
        self.path, self._session = path, session
        inputs = session.get_inputs()
        if len(inputs) != 1 or len(inputs[0].shape) not in (3, 4) or inputs[0].type not in _TYPES:
            told = printable(", ".join(f"{i.name} {i.type} {i.shape}" for i in inputs)[:300])
            raise UserError(
                f"{path}: takes {told}; expected one image, (batch,) 3, height, width; export the "
                "model for images alone"
            )
        self._name, self._dtype = inputs[0].name, _TYPES[inputs[0].type]
        lengths = [n if isinstance(n, int) and n > 0 else None for n in inputs[0].shape]
        self.batched = len(lengths) == 4
        self.batch = lengths.pop(0) if self.batched else 1
        self._channels_last = lengths[0] != 3 and lengths[2] == 3
        height, width = lengths[:2] if self._channels_last else lengths[1:]
        self.size = (width, height) if width and height else None
        if max(width or 1, height or 1) > MAX_INPUT_SIDE or (self.batch or 1) > MAX_BATCH:
            raise UserError(
                f"{path}: takes {self.batch or 'any number of'} images of {width or 'any'}x"
                f"{height or 'any'} pixels, expected at most {MAX_BATCH} of {MAX_INPUT_SIDE} a "
                "side; export it at the size that it was trained with"
            )
        self.metadata: dict[str, str] = dict(session.get_modelmeta().custom_metadata_map)
        self.outputs = [(o.name, tuple(o.shape), o.type) for o in session.get_outputs()]

    @classmethod
    def load(cls, path: Path, device: str = "cpu") -> OnnxModel:
        """Open a model file on ``device`` (cpu or cuda).

        Raises UserError where onnxruntime or the device is not there, or the file is no model that
        takes one image.
        """
        try:
            import onnxruntime
        except ImportError:
            raise UserError(
                f"{path}: running ONNX models needs the package onnxruntime; install it with pip "
                "install 'intercap-core[onnx]' (onnxruntime-gpu for CUDA), or clear the setting"
            ) from None
        wanted = _PROVIDERS[device]
        options = onnxruntime.SessionOptions()
        options.log_severity_level = 3  # errors alone
        options.inter_op_num_threads = 1
        options.intra_op_num_threads = _threads()
        if wanted not in onnxruntime.get_available_providers():
            raise _no_device(path, device, onnxruntime)
        try:
            check_file(path, MAX_NETWORK_BYTES)
            session = onnxruntime.InferenceSession(str(path), options, providers=[wanted])
        except _runtime_errors() as error:
            raise UserError(
                f"{path}: is no ONNX model that can be run ({_first_line(error)}); export it again"
            ) from None
        if wanted not in session.get_providers():  # it falls back to the CPU without a word
            raise _no_device(path, device, onnxruntime)
        return cls(path, session)

    def run(self, images: np.ndarray) -> list[np.ndarray]:
        """Outputs for images (B, 3, H, W) as :func:`fitted` makes them.

        Raises UserError where the model fails on them.
        """
        values = images.transpose(0, 2, 3, 1) if self._channels_last else images
        values = values if self.batched else values[0]
        try:
            found = self._session.run(None, {self._name: np.ascontiguousarray(values, self._dtype)})
        except _runtime_errors() as error:
            raise UserError(
                f"{self.path}: fails on an image of {images.shape[3]}x{images.shape[2]} pixels "
                f"({_first_line(error)}); export it for this size, or for any"
            ) from None
        return [
            np.asarray(v, np.float32) if np.asarray(v).dtype == np.float16 else np.asarray(v)
            for v in found
        ]

    def fitted(
        self, picture: np.ndarray, fit: Fit, size: tuple[int, int], values: PixelValues, pad: int
    ) -> np.ndarray:
        """A BGR picture (H, W, 3) uint8 as the model takes it: (3, h, w) of input ``size``.

        ``pad`` is the grey around it, 0 to 255. A model that takes bytes gets them unscaled.
        """
        width = round(fit.size[0] * fit.scale[0])
        height = round(fit.size[1] * fit.scale[1])
        canvas = np.full((size[1], size[0], 3), pad, np.uint8)
        shrinks = fit.scale[0] < 0.5  # linear interpolation would skip pixels
        canvas[fit.top : fit.top + height, fit.left : fit.left + width] = cv2.resize(
            picture, (width, height), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
        )
        return self.prepared(canvas, values)

    def prepared(self, canvas: np.ndarray, values: PixelValues) -> np.ndarray:
        """A BGR picture (h, w, 3) uint8 of the input's size as the model takes it: (3, h, w)."""
        if values in ("rgb", "imagenet"):
            canvas = canvas[..., ::-1]
        if self._dtype == np.uint8:
            return canvas.transpose(2, 0, 1)
        pixels = canvas.astype(np.float32)
        if values == "rgb":
            pixels /= 255
        elif values == "imagenet":
            pixels = (pixels - IMAGENET_MEAN_RGB) / IMAGENET_DEVIATION_RGB
        elif values == "bgr_mean":
            pixels -= CAFFE_MEAN_BGR
        return pixels.transpose(2, 0, 1)


def fit_within(picture: tuple[int, int], size: tuple[int, int], *, centred: bool) -> Fit:
    """Place a picture (width, height), its shape kept, in an input of ``size``.

    In the middle, or at the upper left.
    """
    ratio = min(size[0] / picture[0], size[1] / picture[1])
    width, height = (max(1, round(n * ratio)) for n in picture)
    # Where the rest is odd, the upper left has the smaller part, as in YOLO's own letterboxing.
    left, top = ((size[0] - width) // 2, (size[1] - height) // 2) if centred else (0, 0)
    return Fit((width / picture[0], height / picture[1]), left, top, picture)


def parse_names(text: str) -> dict[int, str]:
    """Class names by number from a model's metadata: a mapping or a list, as text.

    Exporters write Python's or JSON's notation; it is read, never evaluated. Empty where it is
    neither.
    """
    text = text.strip()
    if len(text) < 2 or text[0] + text[-1] not in ("{}", "[]"):
        return {}
    names: dict[int, str] = {}
    pattern, inner, at = (_NAMED if text[0] == "{" else _LISTED), text[1:-1].rstrip(), 0
    while at < len(inner):
        match = pattern.match(inner, at)
        if match is None:
            return {}
        *number, name = match.groups()
        names[int(number[0]) if number else len(names)] = re.sub(r"\\(.)", r"\1", name[1:-1])
        at = match.end()
    return names


def _runtime_errors() -> tuple[type[Exception], ...]:
    """What onnxruntime raises: a class for each status, and pybind11's own for what it is given."""
    from onnxruntime.capi import onnxruntime_pybind11_state as state

    of_status = [
        c for c in vars(state).values() if isinstance(c, type) and issubclass(c, Exception)
    ]
    return (*of_status, RuntimeError, ValueError, TypeError)


def _threads() -> int:
    """Threads that the job may use, 0 = all; the runtime does not ask OpenMP."""
    text = os.environ.get("OMP_NUM_THREADS", "")
    return int(text) if text.isdecimal() else 0


def _no_device(path: Path, device: str, runtime: Any) -> UserError:
    return UserError(
        f"{path}: onnxruntime {runtime.__version__} finds no {device} here (it has "
        f"{', '.join(runtime.get_available_providers())}); install onnxruntime-gpu with its CUDA, "
        "or set the model's device to cpu"
    )


def _first_line(error: Exception) -> str:
    lines = printable(str(error)).strip().splitlines()
    return lines[0][:300] if lines else type(error).__name__
