"""Distances of the skin from the points of each depth camera, and their mean over the cameras."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor

from intercap_core.body_fit.surface import SAMPLE_SHARE
from intercap_core.body_fit.term_inputs import CloudRows


class ViewDistances(NamedTuple):
    """Measurements at S samples of the skin, by camera, in N frames."""

    distance: Tensor
    """(N, C, S) mean signed distance of the matched points from the skin, outside positive,
    metres."""
    points: Tensor
    """(N, C, S) effective number of matched points, 0 = none."""
    where: Tensor
    """(N, S, 3) position of the samples."""
    normal: Tensor
    """(N, S, 3) normal of the samples."""

    def rows(self, noise: Tensor, cloud_weight: float, points: Tensor) -> CloudRows:
        """Return the rows of E_D, averaged over cameras.

        Args:
            noise: (S,) standard deviation of each sample's covering, metres.
            cloud_weight: weight of E_D.
            points: (N, C, S) effective number of points, the weight of each camera's distance.
        """
        total = points.sum(1)
        mean = (self.distance * points).sum(1) / total.clamp_min(1e-6)
        share = cloud_weight * SAMPLE_SHARE
        # with two points a sample has half its weight; tuned on the studio
        weight = share * total / (total + 2.0) / noise**2
        target = mean + (self.normal * self.where).sum(2)
        return CloudRows(target, self.normal, weight)
