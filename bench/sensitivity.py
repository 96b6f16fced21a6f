"""Errors of a stage with half and with double the value of one of its constants.

    python -m bench.sensitivity [SETTINGS] [--constants object_track.JUMP_COST ...]
        [--sequences ...] [--output docs/sensitivity.md]

The stage is replayed from the project's stored artefacts into a temporary folder, each value in a
separate process; no file of the project is overwritten. The figures are errors against the truth of
virtual recordings. Results are cached by content in ``results/sensitivity.json``, so an interrupted
run continues.
"""

from __future__ import annotations

import argparse
import os
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from bench.changed_constant import Constant, find_constant
from bench.command import exit_on_user_error
from bench.replay import STAGES, Outcome, Replays, Run
from intercap_core.errors import UserError

SETTINGS = Path("config/demo/config.yaml")
SEQUENCES = ("cup_drink_s02", "stool_sit_s01")  # three seconds each, of `make demo`
FACTORS = (0.5, 2.0)
CHANGED = 0.02  # of a figure: the table is silent about what changes less
KNOWN = Path("results/sensitivity.json")
INTRODUCTION = """\
Written by `python -m bench.sensitivity --output docs/sensitivity.md`: each constant's stage is
replayed from stored artefacts with another value, over {sequences} of `{settings}`, and held to the
truth of these virtual recordings. Integers stay integers, shares stay below 1, and of a ratio its
distance from 1 is halved and doubled. A figure is named where it changes by {percent} % and more;
"the same" means to the last digit. `flagged` counts frames that the stage does not trust (of
`scene`: weak pairs of cameras and notes), as a change. Of `segmentation` the object's track is
measured, without a detector's candidates. Short recordings of one studio show which constants
matter, not which value is best: what changes nothing here may still decide on a real recording.
"""


@dataclass(frozen=True)
class Probe:
    """A constant to change, what it decides, and the number that it is an excess over.

    A ratio of 1.15 that stands for "clearly better" is an excess of 0.15 over 1: ``around`` is 1.
    """

    name: str
    decides: str = ""
    around: float = 0.0


# Those that look riskiest on real recordings: thresholds of decisions and trusted deviations that
# were chosen on virtual recordings.
RISKIEST = (
    Probe("object_track.ALWAYS_PRESENT", "a candidate that is always there is furniture"),
    Probe("object_track.SOMETIMES_PRESENT", "one that is there for a while only is not"),
    Probe("object_track.RIVAL_FRAMES", "frames that make what stands elsewhere another thing"),
    Probe("object_track.VIEW_SAMPLES", "how much a view says"),
    Probe("object_track.RIVAL_LOG_RATIO", "hypotheses that are followed"),
    Probe("object_track.AMBIGUOUS_PROBABILITY", "when a rival pose makes a frame ambiguous"),
    Probe("object_track.JUMP_COST", "what a step that no motion explains costs"),
    Probe("object_track.MODE_CHANGES_S", "how often rest, a hand and free motion change"),
    Probe("object_track.FREE_COST_S", "what free motion costs"),
    Probe("object_track.HELD_RAD", "how far a hold turns in the palm"),
    Probe("object_track.ONSET_RAD_S", "how far a hypothesis may turn from frame to frame"),
    Probe("object_track.VANISH_COST", "what going out of sight costs"),
    Probe("object_track.UNHANDLED_LOG_RATIO", "against what moves with nobody near"),
    Probe("object_track.COMMON_ERROR_VARIANCE", "what views err together, in the covariance"),
    Probe("object_track.COMMON_TURN_VARIANCE", "the same of turns"),
    Probe("object_track.SEEN_LOG_RATIO", "when a pose is seen"),
    Probe("object_track.DEPTH_SIGMA_M", "trust in one view's depth"),
    Probe("person.CHANGE_COST", "when a body turns about"),
    Probe("person.MUCH_BETTER", "when a limb's sides are exchanged"),
    Probe("person.EXCHANGED_VIEW_COST", "what each exchanged view costs"),
    Probe("person.SAME_PERSON_GAP_M", "which people of two views are one"),
    Probe(
        "person.segmentation.depth_candidates:PERSON_MARGINS", "what is the person, and no object"
    ),
    Probe("person.segmentation.foreground:GONE_SHARE", "what gives way and is no background"),
    Probe("person.segmentation.depth_candidates:FLOOR_M", "what is the floor"),
    Probe("scene.MIN_SLIP_GAIN", "when a camera slipped, beyond doubt"),
    Probe("scene.CLEAR_SLIP_GAIN", "slipped, rather than late throughout"),
    Probe("scene.SURFACE_SIGMA_FLOOR_M", "trust in surfaces between cameras"),
    Probe("body_fit.PERSISTENCE", "keypoint errors that last"),
    Probe("body_fit.CLOUD_HUBER_M", "outliers of the cloud"),
    Probe("body_fit.LARGEST_SIGMA_M", "when a part is undetermined"),
    Probe("body_fit.MIRRORED_SIGMA_M", "how far a limb of one view may lean"),
    Probe("joint.CONTACT_SIGMA", "how close touching is"),
    Probe("joint.PENETRATION_SIGMA", "how deep sinking in may be"),
    Probe("joint.BODY_ACCELERATION", "how fast bodies start and stop"),
    Probe("joint.OBJECT_DRIFT", "trust in the sequential track"),
)


def probe(replays: Replays, probes: Sequence[Probe]) -> str:
    """Replay all probes; returns the tables as Markdown."""
    constants = [find_constant(p.name) for p in probes]
    for constant in constants:
        if constant.room not in STAGES:
            known = ", ".join(STAGES)
            raise UserError(f"{constant.label}: its room has no stage to replay; rooms: {known}")
    rooms = sorted({c.room for c in constants})
    runs = [Run(room) for room in rooms]
    for one, constant in zip(probes, constants, strict=True):
        runs += [Run(constant.room, constant, factor, one.around) for factor in FACTORS]
    outcomes = replays.of(runs)
    usual = dict(zip(rooms, outcomes, strict=False))
    pairs = [outcomes[at : at + 2] for at in range(len(rooms), len(outcomes), 2)]
    rows = [
        _Row(constant, one, usual[constant.room], *pair)
        for one, constant, pair in zip(probes, constants, pairs, strict=True)
    ]
    return markdown(usual, rows)


@dataclass(frozen=True)
class _Row:
    constant: Constant
    probe: Probe
    usual: Outcome
    half: Outcome
    double: Outcome

    @property
    def worst(self) -> float:
        """The largest relative change of a figure; infinite where a stage failed."""
        if self.half.failure or self.double.failure:
            return float("inf")
        every = (changes(self.usual, self.half), changes(self.usual, self.double))
        return max((abs(share) for found in every for _, _, share in found.values()), default=0.0)


def changes(usual: Outcome, other: Outcome) -> dict[str, tuple[float, float, float]]:
    """Figures, without flags, that differ by 2 % or more: before, after, relative change."""
    found = {}
    for name, before in usual.figures.items():
        after = other.figures.get(name, float("nan"))
        share = (after - before) / max(abs(before), 1e-9) if after != before else 0.0
        if name != "flagged" and not abs(share) < CHANGED:
            found[name] = (before, after, share)
    return found


def markdown(usual: Mapping[str, Outcome], rows: Sequence[_Row]) -> str:
    """Table of the unchanged figures, and table of the constants, most sensitive first."""
    lines = ["| room | figures as the code is | flagged | s |", "|---|---|---|---|"]
    for room, outcome in usual.items():
        text = ", ".join(
            f"{name} {_number(value)}"
            for name, value in outcome.figures.items()
            if name != "flagged"
        )
        lines.append(
            f"| {room} | {text or outcome.failure} | {outcome.figures.get('flagged', 0):.0f} "
            f"| {outcome.seconds:.0f} |"
        )
    lines += [
        "",
        "| constant | decides | value | half: figures | flagged | s | double: figures | flagged "
        "| s |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for row in sorted(rows, key=lambda row: -row.worst):
        cells = [f"`{row.constant.label}`", row.probe.decides, row.half.value]
        for outcome in (row.half, row.double):
            cells += [
                _changes_text(row.usual, outcome),
                _flags(row.usual, outcome),
                f"{outcome.seconds:.0f}",
            ]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def _changes_text(usual: Outcome, outcome: Outcome) -> str:
    if outcome.failure:
        return f"{outcome.changed}: fails, {outcome.failure}"
    found = changes(usual, outcome)
    text = ", ".join(f"{name} {_number(a)} → {_number(b)}" for name, (a, b, _) in found.items())
    if text:
        return f"{outcome.changed}: {text}"
    same = {k: v for k, v in outcome.figures.items()} == dict(usual.figures)
    return f"{outcome.changed}: {'the same' if same else 'less than 2 %'}"


def _flags(usual: Outcome, outcome: Outcome) -> str:
    change = outcome.figures.get("flagged", 0) - usual.figures.get("flagged", 0)
    return f"{change:+.0f}" if change else "="


def _number(value: float) -> str:
    return f"{value:.3g}"


def page(settings: Path, sequences: Sequence[str], tables: str) -> str:
    """The tables with an introduction for readers."""
    words = INTRODUCTION.format(
        sequences=" and ".join(sequences), settings=settings, percent=f"{100 * CHANGED:g}"
    )
    return f"# Constants, halved and doubled\n\n{textwrap.fill(words, 100)}\n\n{tables}"


def main(arguments: Sequence[str] | None = None) -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("settings", type=Path, nargs="?", default=SETTINGS)
    parser.add_argument("--constants", nargs="+", metavar="ROOM.NAME", help="default: the riskiest")
    parser.add_argument("--sequences", nargs="+", help=f"default: {', '.join(SEQUENCES)}")
    parser.add_argument("--output", type=Path, help="Markdown file for the tables")
    parser.add_argument("--known", type=Path, default=KNOWN, help="JSON of what is known already")
    parser.add_argument("--jobs", type=int, default=min(2, os.cpu_count() or 1))
    options = parser.parse_args(arguments)
    with exit_on_user_error():
        sequences = options.sequences or list(SEQUENCES)
        replays = Replays(options.settings, sequences, options.known, options.jobs)
        table = probe(replays, [_probe_of(name) for name in options.constants or []] or RISKIEST)
    print(table)
    if options.output:
        text = page(options.settings, sequences, table)
        options.output.write_text(text, encoding="utf-8")


def _probe_of(name: str) -> Probe:
    """The listed probe of that name, or a default probe."""
    return next((p for p in RISKIEST if p.name == name), Probe(name))


if __name__ == "__main__":
    main()
