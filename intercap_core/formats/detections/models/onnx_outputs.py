"""What the outputs of exported segmentation models mean: instances of one image.

Boxes are two corners in the model's input; masks are sampled where the image's pixels lie in the
model's grid, and only within the box.
"""

from __future__ import annotations

from collections.abc import Mapping

import cv2
import numpy as np

from intercap_core.formats.detections.instance import Instance
from intercap_core.formats.detections.models.onnx_model import Fit
from intercap_core.geometry.camera import masks

NMS_IOU = 0.7  # default of ultralytics' predictors
MAX_BOXES = 3000  # of one image, that enter non-maximum suppression
MAX_INSTANCES = 100  # of one image, the best; as in COCO's evaluation
MASK_PROBABILITY = 0.5  # at the edge of a mask


def yolo_instances(
    rows: np.ndarray,
    prototypes: np.ndarray,
    fit: Fit,
    input_size: tuple[int, int],
    *,
    min_score: float,
    names: Mapping[int, str],
) -> list[Instance]:
    """Instances of a YOLO-seg export.

    ``rows`` (4 + classes + M, N) of box (middle, width, height), class scores and M coefficients,
    or (N, 6 + M) of corners, score, class and coefficients where the model suppresses overlaps
    itself. ``prototypes`` (M, h, w) over the whole input. Raises ValueError where the rows have
    neither shape.
    """
    count = len(prototypes)
    ends_itself = rows.shape[1] == 6 + count
    if not ends_itself:
        rows = rows.T
        if rows.shape[1] < 5 + count:
            raise ValueError(f"{rows.shape[1]} columns are too few for {count} prototypes")
    coefficients = rows[:, -count:]
    if ends_itself:
        corners, scores, classes = rows[:, :4], rows[:, 4], rows[:, 5].astype(int)
        kept = np.flatnonzero(scores >= min_score)
        kept = kept[np.argsort(-scores[kept], kind="stable")]
    else:
        by_class = rows[:, 4:-count]
        classes = by_class.argmax(1)
        scores = by_class[np.arange(len(rows)), classes]
        half = rows[:, 2:4] / 2
        corners = np.concatenate([rows[:, :2] - half, rows[:, :2] + half], 1)
        kept = np.flatnonzero(scores >= min_score)
        kept = kept[suppressed(corners[kept], scores[kept], classes[kept])]
    kept = kept[:MAX_INSTANCES]
    boxes = fit.to_image(corners[kept])
    logits = np.tensordot(coefficients[kept], prototypes, 1)
    steps = input_size[0] / prototypes.shape[2], input_size[1] / prototypes.shape[1]
    found = []
    for k, box, logit in zip(kept.tolist(), boxes, logits, strict=True):
        # Image to grid, in pixel edges: (image * scale + shift) / step
        across = (fit.scale[0] / steps[0], fit.left / steps[0])
        down = (fit.scale[1] / steps[1], fit.top / steps[1])
        label = names.get(int(classes[k]), f"category {int(classes[k])}")
        found.append(_instance(label, float(scores[k]), box, logit, across, down, fit.size, 0.0))
    return [instance for instance in found if instance is not None]


def rcnn_instances(
    corners: np.ndarray,
    classes: np.ndarray,
    scores: np.ndarray,
    probabilities: np.ndarray,
    fit: Fit,
    input_size: tuple[int, int],
    *,
    min_score: float,
    names: Mapping[int, str],
) -> list[Instance]:
    """Instances of a Mask R-CNN or PointRend export.

    ``corners`` (N, 4), ``classes`` (N,), ``scores`` (N,); ``probabilities`` (N, h, w) of the mask
    over the whole input where they have its size, else over the box.
    """
    kept = np.flatnonzero(scores >= min_score)
    kept = kept[np.argsort(-scores[kept], kind="stable")][:MAX_INSTANCES]
    whole = probabilities.shape[1:] == input_size[::-1]
    boxes = fit.to_image(corners[kept])
    found = []
    for k, box in zip(kept.tolist(), boxes, strict=True):
        mask = probabilities[k].astype(np.float32)
        if whole:
            across, down = (fit.scale[0], float(fit.left)), (fit.scale[1], float(fit.top))
        else:
            x0, y0, x1, y1 = (
                (float(v) - shift) / scale
                for v, shift, scale in zip(
                    corners[k], (fit.left, fit.top) * 2, fit.scale * 2, strict=True
                )
            )
            if not (x1 - x0 > 0 and y1 - y0 > 0):
                continue
            height, width = mask.shape
            across = (width / (x1 - x0), -x0 * width / (x1 - x0))
            down = (height / (y1 - y0), -y0 * height / (y1 - y0))
        label = names.get(int(classes[k]), f"category {int(classes[k])}")
        found.append(
            _instance(label, float(scores[k]), box, mask, across, down, fit.size, MASK_PROBABILITY)
        )
    return [instance for instance in found if instance is not None]


def _instance(
    label: str,
    score: float,
    box: np.ndarray,
    grid: np.ndarray,
    across: tuple[float, float],
    down: tuple[float, float],
    size: tuple[int, int],
    threshold: float,
) -> Instance | None:
    """The pixels of ``box`` (x0, y0, x1, y1) at which ``grid`` (h, w) is above the threshold.

    ``across`` and ``down`` are scale and shift from the image's to the grid's pixel edges. The
    instance's box is the mask's own; None where no pixel is set.
    """
    if not np.isfinite(box).all():
        return None
    x0, y0 = int(np.floor(box[0])), int(np.floor(box[1]))
    x1, y1 = min(int(np.ceil(box[2])), size[0]), min(int(np.ceil(box[3])), size[1])
    if x1 <= x0 or y1 <= y0:
        return None
    # Pixel u of the window has its middle at x0 + u + 0.5; the grid's pixel v at v + 0.5.
    inverse = np.array(
        [
            [across[0], 0, across[0] * (x0 + 0.5) + across[1] - 0.5],
            [0, down[0], down[0] * (y0 + 0.5) + down[1] - 0.5],
        ]
    )
    sampled = cv2.warpAffine(
        np.ascontiguousarray(grid, np.float32),
        inverse,
        (x1 - x0, y1 - y0),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REPLICATE,
    )
    rle = masks.encode_window(sampled > threshold, x0, y0, size[1], size[0])
    x, y, width, height = masks.Runs(rle, size[1], size[0]).box
    if not width:
        return None
    return Instance(label, score, (float(x), float(y), float(width), float(height)), rle)


def suppressed(corners: np.ndarray, scores: np.ndarray, classes: np.ndarray) -> np.ndarray:
    """Indices (K,) of the boxes (N, 4) that stay, best first: greedy non-maximum suppression.

    A box goes where a better one of its own class overlaps it by more than ``NMS_IOU``.
    """
    order = np.argsort(-scores, kind="stable")[:MAX_BOXES]
    boxes, kinds = corners[order], classes[order]
    area = np.prod(np.maximum(boxes[:, 2:] - boxes[:, :2], 0), 1)
    alive, kept = np.ones(len(order), bool), []
    for i in range(len(order)):
        if not alive[i]:
            continue
        kept.append(i)
        low = np.maximum(boxes[i, :2], boxes[:, :2])
        high = np.minimum(boxes[i, 2:], boxes[:, 2:])
        common = np.prod(np.maximum(high - low, 0), 1)
        overlap = common / np.maximum(area[i] + area - common, 1e-9)
        alive &= (overlap <= NMS_IOU) | (kinds != kinds[i])
    return order[kept]
