"""The joint energy on a small scene: a body, a box, a floor."""

import numpy as np
import pytest
import trimesh

from intercap_core.body.joints import JOINT_INDEX
from intercap_core.body.model import BodyModel
from intercap_core.config import JointSettings
from intercap_core.geometry.rigid.distance import DistanceField, SurfacePart
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.geometry.rigid.symmetry import SymmetryGroup
from intercap_core.geometry.solve.thread_pool import ThreadPool
from intercap_core.joint.equations import NormalEquations
from intercap_core.joint.floor import Ground
from intercap_core.joint.geometry import Geometry
from intercap_core.joint.minimise import minimise
from intercap_core.joint.problem import Problem, joint_terms
from intercap_core.joint.sequential import TrackedPoses, Trust
from intercap_core.joint.skin import contact_patches
from intercap_core.joint.state import ALL, BODY, State
from intercap_core.joint.terms.contact import ANNOTATED_CONTACT_WEIGHT, CONTACT_TOLERANCE, Contact
from intercap_core.joint.terms.drift import jitter
from intercap_core.joint.terms.object_data import ObjectData
from intercap_core.joint.terms.term import Term
from intercap_core.schemas import CONTACT_REGIONS

FRAMES = 5
LEFT_HAND = CONTACT_REGIONS.index("left_hand")
PLANT = 7  # of the problem's terms


@pytest.fixture(scope="module")
def box() -> ObjectMesh:
    mesh = trimesh.creation.box((0.1, 0.1, 0.1))
    return ObjectMesh(
        name="box",
        vertices=np.asarray(mesh.vertices),
        faces=np.asarray(mesh.faces, np.int32),
        contact_vertices=np.arange(8),
        symmetry=SymmetryGroup.none(),
        colours=np.zeros((8, 3), np.uint8),
    )


class _Hold(Term):
    """A data term that holds the body where it started."""

    name = "body_data"

    def __init__(self, state: State, sigma: float) -> None:
        self._start, self._sigma = state.body.copy(), sigma

    def add(self, state: State, equations: NormalEquations) -> None:
        offset = state.body - self._start
        hessian = np.repeat(np.eye(BODY.stop)[None] / self._sigma**2, len(state), axis=0)
        energy = 0.5 * np.square(offset / self._sigma).sum(axis=1)
        equations.add_blocks(self.name, BODY, hessian, offset / self._sigma**2, energy)


class _Scene:
    """A joint problem with what it is made of."""

    def __init__(
        self,
        model,
        box,
        state,
        *,
        data=(),
        floor=None,
        touching=(),
        known=None,
        start=None,
        still=False,
        settings=None,
        part=None,
    ) -> None:
        field = DistanceField(box.vertices, box.faces)
        touched = None if part is None else SurfacePart(field, box.vertices, box.faces, part)
        self.geometry = Geometry(model, box, field, contact_patches(model), touched)
        self.probability = np.zeros((len(state), len(CONTACT_REGIONS)))
        self.probability[:, list(touching)] = 1
        self.contact = Contact(self.geometry, 1.0)
        self.take(annotated=-1)
        every = np.ones(len(state), bool)
        terms = joint_terms(
            self.geometry,
            settings or JointSettings(),
            start or state,
            data=data,
            contact=self.contact,
            floor=floor,
            fps=15.0,
            trust=Trust(
                body=every,
                object_=every if known is None else known,
                still=np.full(len(state) - 1, still),
            ),
        )
        self.problem = Problem(terms)
        self.problem.refresh(start or state)
        self.equations = self.problem.equations

    def take(self, annotated: int) -> None:
        """Let the contact term use the probability, ``annotated`` alike everywhere."""
        every = np.full(self.probability.shape, annotated, np.int8)
        self.contact.take_contact(self.probability, every)

    def distance(self, state: State) -> np.ndarray:
        """(T, N) of the skin's vertices to the box."""
        return self.geometry.at(state).proximity.distance


def test_how_deep_an_object_is_in_the_body(model, box):
    state = _state(model, 0.05)
    scene = _Scene(model, box, state)
    assert (scene.geometry.at(state).object_depth(ThreadPool()) == 0).all()
    chest = scene.geometry.at(state).joints[0][:, JOINT_INDEX["spine2"]]
    within = State(state.body, state.betas, state.expression, state.rotation, chest)
    assert (scene.geometry.at(within).object_depth(ThreadPool()) > 0.05).all()


@pytest.mark.parametrize(
    ("gap", "times"), [(0.020, ANNOTATED_CONTACT_WEIGHT), (CONTACT_TOLERANCE - 0.0005, 1.0)]
)
def test_an_annotated_contact_draws_more_while_it_stands_apart(model, box, gap, times):
    state = _state(model, gap)
    scene = _Scene(model, box, state, touching=[LEFT_HAND])
    detected = scene.equations(state).energy["contact"]
    for annotated, factor in ((0, 1.0), (1, times)):
        scene.take(annotated)
        scene.problem.refresh(state)
        found = scene.equations(state).energy["contact"]
        assert found == pytest.approx(factor * detected) and found > 0


def test_rows_of_several_threads_are_those_of_one(model, box):
    one = _state(model, -0.004)
    of_frame = np.arange(4 * FRAMES)
    state = State(
        np.random.default_rng(4).normal(0, 0.01, (len(of_frame), BODY.stop)),
        one.betas, np.zeros((len(of_frame), 10)), one.rotation[of_frame % FRAMES],
        one.translation[of_frame % FRAMES],
    )  # fmt: skip
    scene = _Scene(model, box, state, touching=[CONTACT_REGIONS.index("left_hand")])
    alone = scene.problem.equations(state)
    shared = Problem(scene.problem.terms, ThreadPool(3)).equations(state)
    assert (shared.bands == alone.bands).all() and (shared.gradient == alone.gradient).all()
    assert np.abs(alone.bands[2]).max() > 0


def _state(model: BodyModel, gap: float) -> State:
    """Bodies in the T-pose with a box ``gap`` metres below the left palm (y points up here)."""
    body = np.zeros((FRAMES, BODY.stop))
    state = State(body, np.zeros(10), np.zeros((FRAMES, 10)), np.tile(np.eye(3), (FRAMES, 1, 1)),
                  np.zeros((FRAMES, 3)))  # fmt: skip
    palm = model(state.parameters(model)).vertices[0, model.regions["left_hand"]].numpy()
    below = palm[palm[:, 1].argmin()] - [0, 0.05 + gap, 0]
    return State(body, state.betas, state.expression, state.rotation, np.tile(below, (FRAMES, 1)))


def _tracked(state: State, sigma: float, lost: np.ndarray) -> TrackedPoses:
    covariance = np.repeat(np.eye(6)[None] * sigma**2, len(state), axis=0)
    agree = np.zeros_like(lost)
    return TrackedPoses.from_track(
        state.rotation, state.translation, covariance, lost, agree, agree,
        carried=agree, visible=np.ones((len(state), 3), bool), times=np.arange(len(state)) / 15,
        time_offset=np.zeros(3),
    )  # fmt: skip


def test_tracked_poses_follow_the_views_that_they_rest_on():
    """Two cameras found to be 2 and 4 ms later than the tracker took them: the pose is 3 ms late,
    where both see the object."""
    times = np.arange(6) / 15
    way = np.outer(times, [1.0, 0.0, 0.5])
    seen = np.zeros((6, 3), bool)
    seen[:, 1], seen[:3, 2] = True, True
    lost = np.arange(6) == 5
    tracked = TrackedPoses.from_track(
        np.repeat(np.eye(3)[None], 6, 0), way, np.repeat(np.eye(6)[None], 6, 0), lost, lost,
        np.zeros(6, bool), carried=np.zeros(6, bool), visible=seen, times=times,
        time_offset=np.array([0.0, 0.001, 0.0]),
    )  # fmt: skip
    found = tracked.at(np.array([0.0, 0.003, 0.004])).translation - way
    late = np.array([3, 3, 3, 2, 2, 0]) * 1e-3
    assert found == pytest.approx(-late[:, None] * [1.0, 0.0, 0.5])
    assert np.array_equal(tracked.at(tracked.time_offset).translation, way)


def test_carried_poses_keep_their_own_deviations():
    """They are neither bridged as a lost frame's nor widened as ambiguous, nor looked at."""
    sigma = np.diag(np.repeat([0.1, 0.02], 3) ** 2)
    lost, carried, ambiguous = (np.arange(4) == t for t in (1, 2, 3))
    ambiguous |= carried
    tracked = TrackedPoses.from_track(
        np.repeat(np.eye(3)[None], 4, 0), np.zeros((4, 3)), np.repeat(sigma[None], 4, 0), lost,
        ambiguous, np.zeros(4, bool), carried=carried, visible=np.ones((4, 1), bool),
        times=np.arange(4.0), time_offset=np.zeros(1),
    )  # fmt: skip
    turn, shift = np.linalg.inv(tracked.information)[:, [0, 3], [0, 3]].T ** 0.5
    assert turn[[0, 2]] == pytest.approx(0.1, rel=0.01)
    assert shift[[0, 2]] == pytest.approx(0.02, rel=0.01)
    assert shift[1] > 0.1 and turn[3] > 0.15
    assert tracked.seen.tolist() == [True, False, False, True]


def test_an_object_at_rest_moves_as_one(model, box):
    """A hand that comes down onto it frame by frame moves it once, in all of them."""
    state = _state(model, 0.012)
    tracked = _tracked(state, 0.02, np.zeros(FRAMES, bool))
    data = (_Hold(state, 0.02), ObjectData(tracked))
    problem = _Scene(model, box, state, data=data, still=True)
    problem.probability[FRAMES // 2 :, LEFT_HAND] = 1
    problem.take(annotated=-1)
    problem.problem.refresh(state)
    found = minimise(problem.equations, state, max_steps=8).state
    assert np.linalg.norm(found.translation[0] - state.translation[0]) > 0.001
    assert np.linalg.norm(np.diff(found.translation, axis=0), axis=1).max() < 2e-4
    turn = found.rotation[1:] @ found.rotation[:-1].transpose(0, 2, 1)
    assert np.abs(turn - np.eye(3)).max() < np.radians(0.1)


def test_contact_closes_a_gap_between_hand_and_object(model, box):
    state = _state(model, 0.012)
    tracked = _tracked(state, 0.02, np.zeros(FRAMES, bool))
    problem = _Scene(
        model, box, state, data=(_Hold(state, 0.02), ObjectData(tracked)), touching=[LEFT_HAND]
    )
    geometry = problem.geometry
    hand = geometry.skin.patch[geometry.patches.region == LEFT_HAND]
    minimum = minimise(problem.equations, state, max_steps=8)
    assert problem.distance(state)[:, hand].min() > 0.011
    after = problem.distance(minimum.state)[:, hand]
    assert (np.abs(after.min(axis=1)) < 0.004).all()


@pytest.mark.parametrize("side", [1, -1])
def test_contact_draws_to_the_part_that_is_annotated(model, box, side):
    """A hand above the box closes the gap to an annotated top, and comes nearer to an annotated
    bottom; the distances that contact is found by are those to any point."""
    state = _state(model, 0.012)
    tracked = _tracked(state, 0.02, np.zeros(FRAMES, bool))
    part = np.flatnonzero(side * box.vertices[:, 1] > 0)
    data = (_Hold(state, 0.02), ObjectData(tracked))
    scene = _Scene(model, box, state, data=data, touching=[LEFT_HAND], part=part)
    posed = scene.geometry.at(state)
    hand = scene.geometry.skin.patch[scene.geometry.patches.region == LEFT_HAND]
    assert posed.proximity.distance[:, hand].min() == pytest.approx(0.012, abs=1e-3)
    expected = 0.012 if side > 0 else 0.112
    assert posed.touching.distance[:, hand].min() == pytest.approx(expected, abs=1e-3)
    after = minimise(scene.problem.equations, state, max_steps=8).state
    nearest = scene.geometry.at(after).touching.distance[:, hand].min(axis=1)
    assert (nearest < (0.004 if side > 0 else expected - 0.005)).all()


def test_penetration_is_pushed_out(model, box):
    state = _state(model, -0.012)
    tracked = _tracked(state, 0.02, np.zeros(FRAMES, bool))
    problem = _Scene(model, box, state, data=(_Hold(state, 0.02), ObjectData(tracked)))
    minimum = minimise(problem.equations, state, max_steps=8)
    assert (problem.distance(minimum.state).min(axis=1) > -0.006).all()


def _blade() -> ObjectMesh:
    """A sheet of a millimetre that stands on its edge, finely meshed as a scan is."""
    mesh = trimesh.creation.box((0.06, 0.1, 0.001)).subdivide_to_size(0.02)
    return ObjectMesh(
        name="blade",
        vertices=np.asarray(mesh.vertices),
        faces=np.asarray(mesh.faces, np.int32),
        contact_vertices=np.arange(len(mesh.vertices)),
        symmetry=SymmetryGroup.none(),
        colours=np.zeros((len(mesh.vertices), 3), np.uint8),
    )


def _depth_of_blade(model: BodyModel, blade: ObjectMesh, state: State) -> np.ndarray:
    """(T,) how deep its edge is in the body, by the body's whole surface."""
    vertices = model(state.parameters(model)).vertices.double().numpy()
    edge = np.column_stack([np.linspace(-0.03, 0.03, 200), np.full(200, 0.05), np.zeros(200)])
    return np.array(
        [
            -DistanceField(skin, model.faces.numpy()).signed_distance(edge @ r.T + t).min()
            for skin, r, t in zip(vertices, state.rotation, state.translation, strict=True)
        ]
    )


def test_a_rim_between_the_skin_s_vertices_is_pushed_out(model):
    """Its points are inside a finger none of whose vertices is inside it."""
    blade, state = _blade(), _state(model, -0.006)
    tracked = _tracked(state, 0.02, np.zeros(FRAMES, bool))
    scene = _Scene(model, blade, state, data=(_Hold(state, 0.02), ObjectData(tracked)))
    both = scene.problem
    one = Problem(tuple(term for term in both.terms if term.name != "object_in_body"))
    assert len(one.terms) == len(both.terms) - 1
    depth = {}
    for name, problem in (("both", both), ("one", one)):
        found = state
        for _ in range(3):
            problem.refresh(found)
            found = minimise(problem.equations, found, max_steps=5).state
        depth[name] = _depth_of_blade(model, blade, found)
    start = _depth_of_blade(model, blade, state)
    assert (start > 0.003).all()
    assert depth["one"] == pytest.approx(start, abs=1e-4)  # no vertex feels it
    assert (depth["both"] < 0.8 * start).all()


def test_a_floor_carries_the_object(model, box):
    state = _state(model, 0.5)
    top = state.translation[0, 1] - 0.05 + 0.03  # the box starts 3 cm deep in the floor
    floor = Ground(np.array([0, top, 0]), np.array([0, 1.0, 0]))
    tracked = _tracked(state, 0.05, np.zeros(FRAMES, bool))
    problem = _Scene(
        model, box, state, data=(_Hold(state, 0.001), ObjectData(tracked)), floor=floor
    )
    minimum = minimise(problem.equations, state, max_steps=8)
    rise = minimum.state.translation[:, 1] - state.translation[:, 1]
    assert (rise > 0.02).all()


def test_a_lost_frame_is_carried_by_its_neighbours(model, box):
    state = _state(model, 0.5)
    line = state.translation + np.arange(FRAMES)[:, None] * [0.02, 0, 0]
    lost = np.arange(FRAMES) == 2
    good = State(state.body, state.betas, state.expression, state.rotation, line)
    tracked = _tracked(good, 0.005, lost)
    wrong = line.copy()
    wrong[2] += [0.1, 0.1, 0]
    start = State(state.body, state.betas, state.expression, state.rotation, wrong)
    problem = _Scene(model, box, start, data=(_Hold(start, 0.01), ObjectData(tracked)), known=~lost)
    minimum = minimise(problem.equations, start, max_steps=10)
    np.testing.assert_allclose(minimum.state.translation[2], line[2], atol=0.004)


def test_gradient_is_the_derivative_of_the_energy(model, box):
    """With weights that do not depend on the state the equations' gradient is exact."""
    state = _state(model, 0.5)
    rng = np.random.default_rng(0)
    moved = state.moved(rng.normal(scale=0.01, size=(FRAMES, ALL.stop)))
    settings = JointSettings(body_smoothness=1e-4, object_smoothness=1e-4)
    tracked = _tracked(state, 1.0, np.zeros(FRAMES, bool))
    hold = _Hold(state, 0.1)
    problem = _Scene(model, box, moved, data=(hold, ObjectData(tracked)), settings=settings)
    gradient = problem.equations(moved).gradient
    direction = rng.normal(size=(FRAMES, ALL.stop))
    direction /= np.linalg.norm(direction)
    step = 1e-4
    numeric = (
        problem.equations(moved.moved(step * direction)).energy["body_data"]
        - problem.equations(moved.moved(-step * direction)).energy["body_data"]
    ) / (2 * step)
    only = NormalEquations(FRAMES)
    hold.add(moved, only)
    assert numeric == pytest.approx(float((only.gradient * direction).sum()), rel=1e-4)
    assert np.isfinite(gradient).all()


@pytest.mark.parametrize("index", range(2, 13))
def test_each_term_s_gradient_is_the_derivative_of_its_energy(model, box, index):
    """Hand and box overlap, and both reach below the floor; or feet stand, for what plants them."""
    state = _state(model, -0.01)
    floor = Ground(state.translation[0], np.array([0, 1.0, 0]))
    if index == PLANT:
        lowest = model(state.parameters(model)).vertices[0][:, 1].min().item()
        floor = Ground(np.array([0, lowest, 0]), np.array([0, 1.0, 0]))
    data = (_Hold(state, 0.1), ObjectData(_tracked(state, 0.1, np.zeros(FRAMES, bool))))
    scene = _Scene(model, box, state, data=data, floor=floor, touching=[LEFT_HAND])
    term = scene.problem.terms[index]
    assert (index == PLANT) == (term.name == "plant")
    rng = np.random.default_rng(index + 1)
    here = state.moved(rng.normal(scale=0.002, size=(FRAMES, ALL.stop)))
    direction = rng.normal(size=(FRAMES, ALL.stop))
    direction /= np.linalg.norm(direction)

    def equations(at: State) -> NormalEquations:
        found = NormalEquations(FRAMES)
        term.add(at, found)
        assert list(found.energy) == [term.name]
        return found

    step = 1e-3
    assert equations(here).total > 0
    up, down = (equations(here.moved(s * direction)).total for s in (step, -step))
    slope = float((equations(here).gradient * direction).sum())
    assert (up - down) / (2 * step) == pytest.approx(slope, rel=0.02)


def test_a_term_that_is_left_out_leaves_the_others_as_they_are(model, box):
    state = _state(model, -0.01)
    data = (_Hold(state, 0.1), ObjectData(_tracked(state, 0.1, np.zeros(FRAMES, bool))))
    scene = _Scene(model, box, state, data=data, touching=[LEFT_HAND])
    whole = scene.problem.equations(state)
    kept = tuple(term for term in scene.problem.terms if term.name != "penetration")
    rest = Problem(kept).equations(state)
    assert whole.energies.pop("penetration").sum() > 0
    assert rest.energy == whole.energy


def test_a_brief_contact_does_not_shake_a_steady_track(model, box):
    """One frame of contact moves the neighbours along instead of kicking its own frame."""
    state = _state(model, 0.010)
    tracked = _tracked(state, 0.01, np.zeros(FRAMES, bool))
    problem = _Scene(model, box, state, data=(_Hold(state, 0.001), ObjectData(tracked)))
    problem.probability[2, LEFT_HAND] = 1
    problem.take(annotated=-1)
    problem.problem.refresh(state)
    moved = minimise(problem.equations, state, max_steps=8).state.translation - state.translation
    assert np.abs(np.diff(moved, axis=0)).max() < 0.002


def test_jitter_is_the_noise_of_a_smooth_motion():
    rng = np.random.default_rng(5)
    t = np.arange(200)[:, None, None] / 30
    smooth = np.concatenate([np.sin(t), np.cos(1.3 * t), t], axis=2)
    noisy = smooth + rng.normal(scale=0.003, size=smooth.shape)
    assert jitter(noisy, np.ones(200, bool)) == pytest.approx(0.003, rel=0.2)
    assert jitter(smooth, np.ones(200, bool)) < 1e-5


def test_without_its_weight_drift_is_gone_but_for_what_rests(model, box):
    """Of both drift terms only the object at rest is left."""
    state = _state(model, 0.5)
    rng = np.random.default_rng(4)
    moved = state.moved(rng.normal(scale=0.002, size=(FRAMES, ALL.stop)))
    energies = {}
    for still in (False, True):
        for weight in (0.0, 1.0, 2.0):
            settings = JointSettings(drift_weight=weight)
            scene = _Scene(model, box, moved, start=state, still=still, settings=settings)
            energies[still, weight] = scene.equations(moved).energy
    for still in (False, True):
        assert energies[still, 0.0]["body_drift"] == 0
        assert energies[still, 2.0]["body_drift"] == 2 * energies[still, 1.0]["body_drift"] > 0
    assert energies[False, 0.0]["object_drift"] == 0 < energies[False, 1.0]["object_drift"]
    assert energies[True, 0.0]["object_drift"] == energies[True, 1.0]["object_drift"] > 0
