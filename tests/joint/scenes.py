"""A small joint problem: bodies in the T-pose with a box below the left palm."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import trimesh

from intercap_core.body.model import BodyModel
from intercap_core.config import JointSettings
from intercap_core.geometry.camera.transforms import rigid
from intercap_core.geometry.rigid.distance import DistanceField, SurfacePart
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.geometry.rigid.symmetry import SymmetryGroup
from intercap_core.joint.equations import BandedEquations
from intercap_core.joint.floor import FloorPlane
from intercap_core.joint.geometry import Geometry
from intercap_core.joint.minimise import Minimum, minimise
from intercap_core.joint.problem import JointProblem, build_terms
from intercap_core.joint.sequential import TrackedPoses, TrackMarks, Trust
from intercap_core.joint.skin import contact_patches
from intercap_core.joint.state import BODY, State
from intercap_core.joint.terms.contact import Contact
from intercap_core.joint.terms.object_data import ObjectData
from intercap_core.joint.terms.term import JointTerm, TermContext
from intercap_core.schemas import CONTACT_REGIONS

FRAMES, FPS = 5, 15.0
LEFT_HAND = CONTACT_REGIONS.index("left_hand")


def object_mesh(mesh: trimesh.Trimesh) -> ObjectMesh:
    """The mesh as an object without symmetry."""
    return ObjectMesh(
        name="mesh",
        vertices=np.asarray(mesh.vertices),
        faces=np.asarray(mesh.faces, np.int32),
        contact_vertices=np.arange(len(mesh.vertices)),
        symmetry=SymmetryGroup.none(),
        colours=np.zeros((len(mesh.vertices), 3), np.uint8),
    )


BOX = object_mesh(trimesh.creation.box((0.1, 0.1, 0.1)))


def bodies(model: BodyModel, gap: float, frames: int = FRAMES) -> State:
    """T-poses with a box ``gap`` metres below the left palm; y points up."""
    state = State(
        np.zeros((frames, BODY.stop)), np.zeros(10), np.zeros((frames, 10)),
        np.tile(np.eye(3), (frames, 1, 1)), np.zeros((frames, 3)),
    )  # fmt: skip
    palm = model(state.parameters(model)).vertices[0, model.regions["left_hand"]].numpy()
    below = palm[palm[:, 1].argmin()] - [0, 0.05 + gap, 0]
    return with_object_at(state, np.tile(below, (frames, 1)))


def with_object_at(state: State, translation: np.ndarray) -> State:
    """The state with the object at ``translation`` (T, 3)."""
    return replace(state, translation=translation)


def floor_under_soles(model: BodyModel, state: State) -> FloorPlane:
    """The floor on which the first body stands."""
    lowest = model(state.parameters(model)).vertices[0][:, 1].min().item()
    return FloorPlane(np.array([0, lowest, 0]), np.array([0, 1.0, 0]))


def tracked(state: State, sigma: float, lost: np.ndarray | None = None) -> TrackedPoses:
    """The state's poses as a track with standard deviation ``sigma``, rad and metres."""
    count = len(state)
    no = np.zeros(count, bool)
    return TrackedPoses.from_track(
        rigid(state.rotation, state.translation),
        np.repeat(np.eye(6)[None] * sigma**2, count, axis=0),
        TrackMarks(lost=no if lost is None else lost, ambiguous=no, carried=no, resting=no),
        visible=np.ones((count, 3), bool),
        times=np.arange(count) / FPS,
    )


class Hold(JointTerm):
    """A data term that holds the body where it started."""

    name = "body_data"

    def __init__(self, state: State, sigma: float) -> None:
        self._start, self._sigma = state.body.copy(), sigma

    def add(self, state: State, equations: BandedEquations) -> None:
        offset = state.body - self._start
        hessian = np.repeat(np.eye(BODY.stop)[None] / self._sigma**2, len(state), axis=0)
        energy = 0.5 * np.square(offset / self._sigma).sum(axis=1)
        equations.add_blocks(self.name, BODY, hessian, offset / self._sigma**2, energy)


@dataclass(eq=False)
class Scene:
    """All terms about a state."""

    model: BodyModel
    state: State
    mesh: ObjectMesh = BOX
    hold: float | None = None
    """Standard deviation of the body's data; None for no data."""
    track: float | None = None
    """Standard deviation of the object's track, rad and metres; None for no data."""
    lost: np.ndarray | None = None
    """(T,) frames in which the object is lost."""
    seen: State | None = None
    """State of the track, if it differs."""
    start: State | None = None
    """Sequential fits, if they differ."""
    floor: FloorPlane | None = None
    touching: tuple[int, ...] = ()
    """Regions that touch with probability 1."""
    resting: bool = False
    part: np.ndarray | None = None
    """Vertices of the object that contact draws skin to."""
    settings: JointSettings = field(default_factory=JointSettings)

    def __post_init__(self) -> None:
        self.probability = np.zeros((len(self.state), len(CONTACT_REGIONS)))
        self.probability[:, list(self.touching)] = 1
        self.take_contact()

    @cached_property
    def geometry(self) -> Geometry:
        mesh = self.mesh
        surface = DistanceField(mesh.vertices, mesh.faces)
        touched = None
        if self.part is not None:
            touched = SurfacePart(surface, mesh.vertices, mesh.faces, self.part)
        return Geometry(self.model, mesh, surface, contact_patches(self.model), touched)

    @cached_property
    def context(self) -> TermContext:
        every = np.ones(len(self.state), bool)
        return TermContext(
            geometry=self.geometry,
            settings=self.settings,
            start=self.start or self.state,
            trust=Trust(
                body=every,
                object_=every if self.lost is None else ~self.lost,
                still=np.full(len(self.state) - 1, self.resting),
            ),
            fps=FPS,
            floor=self.floor,
        )

    @cached_property
    def problem(self) -> JointProblem:
        data: list[JointTerm] = []
        if self.hold is not None:
            data.append(Hold(self.state, self.hold))
        if self.track is not None:
            data.append(ObjectData(tracked(self.seen or self.state, self.track, self.lost)))
        return JointProblem(build_terms(self.context, data))

    def term(self, kind: type[JointTerm]) -> JointTerm:
        """The term of this class."""
        return next(term for term in self.problem.terms if type(term) is kind)

    def take_contact(self, annotated: int = -1) -> None:
        """Set the probability of contact, and one label for all; refresh all terms."""
        contact = self.term(Contact)
        assert isinstance(contact, Contact)
        contact.take_contact(self.probability, np.full(self.probability.shape, annotated, np.int8))
        self.problem.refresh(self.start or self.state)

    def minimise(self, max_steps: int = 8) -> Minimum:
        """Minimise all terms from the state."""
        return minimise(self.problem, self.state, max_steps=max_steps)

    def distance(self, state: State, region: int | None = None) -> np.ndarray:
        """Distances (T, N) of the skin samples, or of a region's, to the object."""
        distance = self.geometry.at(state).proximity.distance
        if region is None:
            return distance
        return distance[:, self.geometry.skin.patch[self.geometry.patches.region == region]]


def check_gradient(term: JointTerm, state: State, *, step: float = 1e-3, rel: float = 0.02) -> None:
    """Compare a term's gradient with the central difference of its energy, which must not be 0."""
    rng = np.random.default_rng(3)
    direction = rng.normal(size=(len(state), 174))
    direction /= np.linalg.norm(direction)

    def equations(at: State) -> BandedEquations:
        sums = BandedEquations(len(state))
        term.add(at, sums)
        assert list(sums.energy) == [term.name]
        return sums

    here = equations(state)
    assert here.total > 0
    up, down = (equations(state.moved(s * direction)).total for s in (step, -step))
    slope = float((here.gradient * direction).sum())
    assert abs((up - down) / (2 * step) - slope) <= rel * abs(slope)
