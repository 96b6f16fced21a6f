"""The subject among the people of a recording: named by the user, or chosen by their actions.

People are matched over views (:mod:`.groups`), followed over time and recognised after an absence
(:mod:`.tracks`). The subject is the person named by the user, if any. Otherwise it is the person of
greatest score. The score is the support summed over sets, with less weight far from the centre of
the ring of cameras. It is multiplied by up to 5 for contact with the object.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from intercap_core.body.keypoints import NUM_KEYPOINTS
from intercap_core.errors import UserError
from intercap_core.formats.detections.read import PeopleOfImages
from intercap_core.geometry.camera.rig import Rig, ring_centre
from intercap_core.geometry.camera.triangulation import pixel_scale, reproject
from intercap_core.person.groups import (
    MIN_DISTANCE_M,
    NOBODY,
    SAME_PERSON_PX_AT_1080P,
    Lift,
    PersonGroup,
    distance_to,
    group_set,
    lifted_groups,
)
from intercap_core.person.sides import BODY_POINTS
from intercap_core.person.tracks import (
    MAX_LINK_GAP_S,
    Person,
    PersonTrack,
    join_tracks,
    link_groups,
)

# The score of the person who touches the object most is multiplied by 1 + HANDLING_WEIGHT, that of
# others in proportion to their contact. Not tuned. In config/field/passer_by.yaml, the choice of
# the subject is reported as doubtful with half of it; double changes nothing.
HANDLING_WEIGHT = 4.0
# Another person is reported if its score is at least this share of the subject's. Not tuned. With
# half of it, a second person is reported although the subject is clear
# (config/field/passer_by.yaml).
RIVAL_SHARE = 0.5

Touches = Callable[[int, int, int], bool | None]
"""Function of set t, camera c and person i of that image: whether the person touches the object.

None = the object is not visible there."""


@dataclass(frozen=True)
class NamedDetection:
    """A detection that the user names as the subject."""

    t: int
    """Frame set."""
    c: int
    """Camera index."""
    index: int
    """Index of the person in the image."""
    words: str
    """Entry of the annotation, for messages."""


@dataclass(frozen=True, eq=False)
class SubjectDetections:
    """The subject in all images."""

    people: np.ndarray
    """(T, C) int32: index of the subject's detection; -1 = not seen."""
    others: np.ndarray
    """(T,) int32: number of other located people."""
    chosen_by: str
    """How the subject was chosen: "named" by the user, "alone" (nobody else is likely), "handling"
    (contact with the object), or "middle" (support and position)."""
    doubts: tuple[str, ...]
    """Reasons why the choice may be wrong, as messages."""


def find_subject(
    detections: PeopleOfImages,
    rig: Rig,
    times: np.ndarray,
    *,
    min_confidence: float,
    lift: Lift | None = None,
    touches: Touches | None = None,
    named: Sequence[NamedDetection] = (),
) -> SubjectDetections:
    """Find the subject in every image; -1 everywhere if no person can be located in any set.

    Args:
        detections: people of each image, by moment.
        times: (T,) seconds.
        min_confidence: keypoints of lower confidence are ignored.
        lift: locates people of single views in sets in which no two views agree on a person.
        touches: contact with the object; None = not evaluated.
        named: detections named by the user.

    Raises:
        UserError: the user names two people who are seen at the same time.
    """
    groups = []
    for t in range(detections.num_sets):
        seen = [detections.people(t, c)[:, BODY_POINTS] for c in range(len(rig))]
        people_here = group_set(seen, rig, min_confidence)
        if not people_here and lift is not None:
            people_here = lifted_groups(t, seen, lift)
        groups.append(people_here)
    tracks = link_groups(groups, times)
    people = np.full((detections.num_sets, len(rig)), NOBODY, np.int32)
    chosen, by, doubts = _chosen(tracks, times, ring_centre(rig), touches, named)
    for t, group in chosen.groups.items():
        people[t] = group.members
    _add_single_views(people, chosen, groups, detections, rig, times, min_confidence)
    for detection in named:
        people[detection.t, detection.c] = detection.index
    counts = np.array([len(people_here) for people_here in groups], np.int32)
    others = counts - np.isin(np.arange(len(counts)), list(chosen.groups))
    return SubjectDetections(people, others, by, tuple(doubts))


def subject_keypoints(detections: PeopleOfImages, people: np.ndarray) -> np.ndarray:
    """Keypoints (T, C, 135, 3) of the detections ``people`` (T, C); 0 for index -1."""
    result = np.zeros((*people.shape, NUM_KEYPOINTS, 3))
    for t, c in np.argwhere(people != NOBODY).tolist():
        result[t, c] = detections.people(t, c)[people[t, c]]
    return result


def _chosen(
    tracks: list[PersonTrack],
    times: np.ndarray,
    middle: np.ndarray,
    touches: Touches | None,
    named: Sequence[NamedDetection],
) -> tuple[PersonTrack, str, list[str]]:
    """The subject's track, how it was chosen, and doubts; see :class:`SubjectDetections`.

    ``middle``: (3,) centre of the ring of cameras, metres.
    """
    first, doubts = _of_named(tracks, named, times)
    people = join_tracks(tracks, times, first)
    if first:
        return people[0].track, "named", [*doubts, *people[0].doubts]
    if not people:
        return PersonTrack({}), "alone", doubts
    scores = [_score(person.track, middle) for person in people]
    order = np.argsort(scores)[::-1].tolist()
    # people of a lower score stay below RIVAL_SHARE even if they touch the object most
    least = RIVAL_SHARE / (1 + HANDLING_WEIGHT) * scores[order[0]]
    likely = {k: scores[k] for k in order if scores[k] > least}
    by = "alone"
    if len(likely) > 1:
        handling = {k: _handling(people[k].track, touches) if touches else 0.0 for k in likely}
        most = max(handling.values())
        by = "handling" if most >= 0.05 else "middle"  # share of the images; untuned
        if by == "handling":
            likely = {
                k: score * (1 + HANDLING_WEIGHT * handling[k] / most) for k, score in likely.items()
            }
    best, *others = sorted(likely, key=lambda k: -likely[k])
    doubts += people[best].doubts
    if others and likely[others[0]] > RIVAL_SHARE * likely[best]:
        doubts.append(_rival(people[others[0]], times, by))
    return people[best].track, by, doubts


def _of_named(
    tracks: list[PersonTrack], named: Sequence[NamedDetection], times: np.ndarray
) -> tuple[list[PersonTrack], list[str]]:
    """Tracks of the named detections, and a message for those without a track."""
    chosen: dict[int, tuple[PersonTrack, NamedDetection]] = {}
    lost = []
    for detection in named:
        track = next((k for k in tracks if _has(k, detection)), None)
        if track is None:
            lost.append(detection)
            continue
        for other, before in chosen.values():
            if (t := _two_people(other, track)) is not None:
                raise UserError(
                    f"{before.words} and {detection.words} name two people: both are seen at frame "
                    f"{t} ({times[t] - times[0]:.2f} s); keep the points that lie on one person"
                )
        chosen.setdefault(id(track), (track, detection))
    words = ", ".join(detection.words for detection in lost)
    doubt = (
        f"who is named by {words} is placed by no two views there and could not be followed; name "
        "the person in a frame in which more cameras see it"
    )
    return [track for track, _ in chosen.values()], [doubt] if lost else []


def _two_people(first: PersonTrack, second: PersonTrack) -> int | None:
    """Set that shows two tracks as two people most clearly; None if they may be one person.

    They are two people if their distance is too large in half of the shared sets. Without shared
    points it is unknown, and two detections in one image decide.
    """
    if first is second:
        return None
    shared = Person((first,)).shared(Person((second,)))
    apart = [
        (np.inf if group.shares_view(other) else 0.0) if np.isnan(distance) else distance
        for _, group, other in shared
        for distance in [group.shared_distance(other)]
    ]
    if not apart or np.median(apart) <= MIN_DISTANCE_M:
        return None
    return shared[int(np.argmax(apart))][0]


def _has(track: PersonTrack, named: NamedDetection) -> bool:
    group = track.groups.get(named.t)
    return group is not None and bool(group.members[named.c] == named.index)


def _score(track: PersonTrack, middle: np.ndarray) -> float:
    """Support of a track, summed over sets.

    A set at a distance of 1.5 m from the ring's centre ``middle`` (3,) counts half; tuned on the
    studio.
    """
    return sum(
        group.support / (1 + (float(np.linalg.norm(group.centre - middle)) / 1.5) ** 2)
        for group in track.groups.values()
    )


def _handling(track: PersonTrack, touches: Touches) -> float:
    """Share of contact among the images that show both the person and the object; 0 = no images."""
    contacts = [
        touches(t, c, int(group.members[c]))
        for t, group in track.groups.items()
        for c in np.flatnonzero(group.members != NOBODY).tolist()
    ]
    known = [touch for touch in contacts if touch is not None]
    return sum(known) / len(known) if known else 0.0


def _rival(rival: Person, times: np.ndarray, by: str) -> str:
    """Message that another person may be the subject; ``by``: how the subject was chosen."""
    why = "touches the object more" if by == "handling" else "is seen more, or nearer the middle"
    return (
        f"another person is seen in {len(rival.track.groups)} of {len(times)} frames, from frame "
        f"{min(rival.track.groups)} on; the subject is taken to be the one who {why}, which is not "
        "clear: name it by a point in an image (annotation 'subject')"
    )


def _add_single_views(
    people: np.ndarray,
    chosen: PersonTrack,
    groups: Sequence[Sequence[PersonGroup]],
    detections: PeopleOfImages,
    rig: Rig,
    times: np.ndarray,
    min_confidence: float,
) -> None:
    """Add detections to ``people`` (T, C), in place, in sets in which the subject has no group.

    In each view the detection closest to the subject's points of the nearest known set is added, if
    it is within twice the usual limit. Detections of people whom several views locate are excluded.
    """
    if not chosen.groups:
        return
    known = np.array(list(chosen.groups))
    limits = SAME_PERSON_PX_AT_1080P * pixel_scale(rig)
    for t in np.setdiff1d(np.arange(len(people)), known).tolist():
        place = int(np.argmin(np.abs(known - t)))
        if abs(times[t] - times[known[place]]) > MAX_LINK_GAP_S:
            continue
        points = chosen.groups[int(known[place])].points
        pixels = reproject(np.nan_to_num(points), rig)
        for c in range(len(rig)):
            best = 2.0 * limits[c]  # the subject moves in between
            placed = {int(group.members[c]) for group in groups[t] if group.views > 1}
            for i, person in enumerate(detections.people(t, c)):
                if i in placed:
                    continue
                body = person[BODY_POINTS]
                seen = body[:, 2] >= min_confidence
                error, _ = distance_to(pixels[:, c], np.isfinite(points[:, 0]), body, seen)
                if error < best:
                    best, people[t, c] = error, i
