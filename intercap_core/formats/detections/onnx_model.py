"""A user's ONNX model: its session, its input, and images that are fitted to the input.

Nothing in a model file is run as code except its graph; custom operators are not loaded.
"""

from __future__ import annotations

import ast
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np

from intercap_core.errors import UserError
from intercap_core.formats.detections.class_names import parse_class_names
from intercap_core.geometry.solve.thread_pool import threads_of_job
from intercap_core.inputs.files import check_file, printable, referenced_files

FLOATS = ("tensor(float)", "tensor(float16)")  # types of outputs
PixelValues = Literal["rgb", "bgr255", "bgr_mean", "imagenet"]

# Offset and scale of each channel: an input is (grey level - offset) / scale.
_NORMALISATION: dict[PixelValues, tuple[list[float], list[float]]] = {
    "rgb": ([0, 0, 0], [255, 255, 255]),
    "bgr255": ([0, 0, 0], [1, 1, 1]),
    # mean of ImageNet, blue first, as in Caffe's models; maskrcnn-benchmark subtracts it
    "bgr_mean": ([102.9801, 115.9465, 122.7717], [1, 1, 1]),
    # mean and standard deviation of ImageNet, red first, as in torchvision and mmpose
    "imagenet": ([123.675, 116.28, 103.53], [58.395, 57.12, 57.375]),
}

_TYPES = {"tensor(float)": np.float32, "tensor(float16)": np.float16, "tensor(uint8)": np.uint8}
_PROVIDERS = {"cpu": "CPUExecutionProvider", "cuda": "CUDAExecutionProvider"}


@dataclass(frozen=True)
class Fit:
    """Where an image lies in the model's input: input = image * scale + (left, top).

    Coordinates are of pixel edges: the middle of the first pixel is at 0.5.
    """

    scale: tuple[float, float]
    """Factors of x and y."""
    left: int
    """Shift of x, px."""
    top: int
    """Shift of y, px."""
    size: tuple[int, int]
    """Width and height of the image."""

    def to_image(self, boxes: np.ndarray) -> np.ndarray:
        """Map boxes (N, 4) of two corners from the input to the image and clip them to it."""
        shift, scale = (self.left, self.top) * 2, self.scale * 2
        corners = (boxes - np.array(shift, np.float32)) / np.array(scale, np.float32)
        return np.clip(corners, 0, np.array(self.size * 2, np.float32))


class OnnxModel:
    """An open session with one image as input; obtained from :meth:`load`."""

    size: tuple[int, int] | None
    """Width and height of the input; None = any."""
    batch: int | None
    """Number of images in one input; None = any."""
    outputs: list[tuple[str, tuple[Any, ...], str]]
    """Name, declared shape (numbers, or names of free lengths) and type of each output."""
    metadata: dict[str, str]
    """Entries that the exporter wrote into the file."""

    def __init__(self, path: Path, session: Any) -> None:
        self.path, self._session = path, session
        inputs = session.get_inputs()
        if len(inputs) != 1 or len(inputs[0].shape) not in (3, 4) or inputs[0].type not in _TYPES:
            inputs_text = printable(", ".join(f"{i.name} {i.type} {i.shape}" for i in inputs)[:300])
            raise UserError(
                f"{path}: takes {inputs_text}; expected one image, (batch,) 3, height, width; "
                "export the model for images alone"
            )
        self._name, self._dtype = inputs[0].name, _TYPES[inputs[0].type]
        lengths = [n if isinstance(n, int) and n > 0 else None for n in inputs[0].shape]
        self.batched = len(lengths) == 4
        self.batch = lengths.pop(0) if self.batched else 1
        self._channels_last = lengths[0] != 3 and lengths[2] == 3
        height, width = lengths[:2] if self._channels_last else lengths[1:]
        self.size = (width, height) if width and height else None
        if max(width or 1, height or 1) > 8192 or (self.batch or 1) > 256:  # detectors: up to 1333
            raise UserError(
                f"{path}: takes {self.batch or 'any number of'} images of {width or 'any'}x"
                f"{height or 'any'} pixels, expected at most 256 of 8192 a side; export it at the "
                "size that it was trained with"
            )
        self.metadata = dict(session.get_modelmeta().custom_metadata_map)
        self.outputs = [(o.name, tuple(o.shape), o.type) for o in session.get_outputs()]

    @classmethod
    def load(cls, path: Path, device: str = "cpu") -> OnnxModel:
        """Open a model file on ``device`` (cpu or cuda).

        Raises UserError if onnxruntime or the device is missing, or if the file is no model of one
        image.
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
        options.log_severity_level = 3  # only errors
        options.inter_op_num_threads = 1
        options.intra_op_num_threads = threads_of_job()
        if wanted not in onnxruntime.get_available_providers():
            raise _no_device(path, device, onnxruntime)
        try:
            check_file(path, 1 << 31)  # limit of the format; larger models store weights elsewhere
            for weights in referenced_files(path):
                if weights.exists():
                    check_file(weights, None, advice=f"export {path.name} again")
            session = onnxruntime.InferenceSession(str(path), options, providers=[wanted])
        except _runtime_errors() as error:
            raise UserError(
                f"{path}: is no ONNX model that can be run ({_first_line(error)}); export it again"
            ) from None
        if wanted not in session.get_providers():  # onnxruntime falls back to the CPU silently
            raise _no_device(path, device, onnxruntime)
        try:
            return cls(path, session)
        except UnicodeDecodeError:
            raise UserError(
                f"{path}: is no ONNX model that can be run (a name is not UTF-8); export it again"
            ) from None

    def run(self, images: np.ndarray) -> list[np.ndarray]:
        """Outputs for images (B, 3, H, W); raises UserError if the model fails on them.

        For a model with a fixed batch size the last image is repeated.
        """
        missing = (self.batch or 0) - len(images)
        if missing > 0:
            images = np.concatenate([images, np.repeat(images[-1:], missing, 0)])
        values = images.transpose(0, 2, 3, 1) if self._channels_last else images
        values = values if self.batched else values[0]
        try:
            feed = {self._name: np.ascontiguousarray(values, self._dtype)}
            outputs = self._session.run(None, feed)
        except _runtime_errors() as error:
            raise UserError(
                f"{self.path}: fails on an image of {images.shape[3]}x{images.shape[2]} pixels "
                f"({_first_line(error)}); export it for this size, or for any"
            ) from None
        return [
            np.asarray(v, np.float32) if np.asarray(v).dtype == np.float16 else np.asarray(v)
            for v in outputs
        ]

    def fit_picture(
        self, picture: np.ndarray, fit: Fit, size: tuple[int, int], values: PixelValues, pad: int
    ) -> np.ndarray:
        """Fit a BGR picture (H, W, 3) uint8 into the input: (3, h, w) of ``size`` (width, height).

        ``pad`` is the grey level, 0 to 255, around the picture.
        """
        width = round(fit.size[0] * fit.scale[0])
        height = round(fit.size[1] * fit.scale[1])
        canvas = np.full((size[1], size[0], 3), pad, np.uint8)
        shrinks = fit.scale[0] < 0.5  # linear interpolation would skip pixels
        canvas[fit.top : fit.top + height, fit.left : fit.left + width] = cv2.resize(
            picture, (width, height), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
        )
        return self.to_input_values(canvas, values)

    def to_input_values(self, canvas: np.ndarray, values: PixelValues) -> np.ndarray:
        """Convert a BGR picture (h, w, 3) uint8 of the input's size to its values (3, h, w).

        A model whose input is of bytes gets bytes.
        """
        if values in ("rgb", "imagenet"):
            canvas = canvas[..., ::-1]
        if self._dtype == np.uint8:
            return canvas.transpose(2, 0, 1)
        offset, scale = np.array(_NORMALISATION[values], np.float32)
        return ((canvas - offset) / scale).transpose(2, 0, 1)


def place_picture(picture: tuple[int, int], size: tuple[int, int], *, centred: bool) -> Fit:
    """Place a picture (width, height) in an input of ``size`` without changing its aspect ratio.

    The picture is in the middle if ``centred``, otherwise at the upper left.
    """
    ratio = min(size[0] / picture[0], size[1] / picture[1])
    width, height = (max(1, round(n * ratio)) for n in picture)
    # An odd rest is larger at the lower right, as in YOLO's letterboxing.
    left, top = ((size[0] - width) // 2, (size[1] - height) // 2) if centred else (0, 0)
    return Fit((width / picture[0], height / picture[1]), left, top, picture)


def parse_names(text: str) -> dict[int, str]:
    """Class names by number from a model's metadata; {} for text without names.

    The text is a mapping or a list in the notation of Python or JSON. It is parsed, not evaluated.
    """
    try:
        return parse_class_names(ast.literal_eval(text))
    except (ValueError, SyntaxError, TypeError, MemoryError, RecursionError):
        return {}


def _runtime_errors() -> tuple[type[Exception], ...]:
    """Exceptions of onnxruntime: a class for each status, and pybind11's for wrong arguments."""
    from onnxruntime.capi import onnxruntime_pybind11_state as state

    of_status = [
        c for c in vars(state).values() if isinstance(c, type) and issubclass(c, Exception)
    ]
    return (*of_status, RuntimeError, ValueError, TypeError)


def _no_device(path: Path, device: str, runtime: Any) -> UserError:
    return UserError(
        f"{path}: onnxruntime {runtime.__version__} finds no {device} here (it has "
        f"{', '.join(runtime.get_available_providers())}); install onnxruntime-gpu with its CUDA, "
        "or set the model's device to cpu"
    )


def _first_line(error: Exception) -> str:
    lines = printable(str(error)).strip().splitlines()
    return lines[0][:300] if lines else type(error).__name__
