# SPDX-License-Identifier: MIT
"""sim/diagnose/soft on small captures made here: causes in flight and in matter are found, none where there is none."""

import dataclasses
import itertools

import numpy as np
import pytest
from physgen.sim.diagnose.capture import Capture, CaptureObject, Ground, ObjectBelief, Trial
from physgen.sim.diagnose.soft.body_mesh import body_mesh
from physgen.sim.diagnose.soft.candidate_survey import Survey
from physgen.sim.diagnose.soft.contact_search import CandidateSearch
from physgen.sim.diagnose.soft.flight_fits import Flights, GroundFrame, fit_in_flight, soft_trial
from physgen.sim.diagnose.soft.free_flight import State
from physgen.sim.diagnose.soft.soft_candidates import WorldParameters, candidates
from physgen.sim.diagnose.soft.soft_fits import fit_soft
from physgen.sim.diagnose.soft.soft_simulator import SimulationJob, SoftWorlds
from physgen.sim.diagnose.work import Work
from physgen.sim.errors import Cancelled, InputError
from physgen.sim.events import ignore, never
from scipy.spatial.transform import Rotation

SIGMA = 5e-4
NOMINAL = WorldParameters(modulus=8e4, poisson_ratio=0.3, friction=0.4, gravity=(0.0, 0.0, -9.81))


def cube_surface(side=0.06, cells=4, away=False):
    """A cube's surface whose vertices are those of a lattice; its diagonals alike, or ``away`` from the middle."""
    lattice = np.stack(np.meshgrid(*[np.linspace(-side / 2, side / 2, cells + 1)] * 3, indexing="ij"), -1).reshape(
        -1, 3
    )
    index = np.arange((cells + 1) ** 3).reshape((cells + 1,) * 3)
    faces = []
    for axis, end in itertools.product(range(3), (0, cells)):
        plane = np.take(index, end, axis=axis)
        a, b, c, d = (x.ravel() for x in (plane[:-1, :-1], plane[1:, :-1], plane[1:, 1:], plane[:-1, 1:]))
        row, column = (2 * i.ravel() + 1 - cells for i in np.indices((cells, cells)))
        alike = (row * column > 0)[:, None] if away else np.ones((len(a), 1), dtype=bool)
        first = np.where(alike, np.stack([a, b, c], 1), np.stack([a, b, d], 1))
        quads = np.concatenate([first, np.where(alike, np.stack([a, c, d], 1), np.stack([b, c, d], 1))])
        outward = (end > 0) == (axis != 1)
        faces.append(quads if outward else quads[:, ::-1])
    used, again = np.unique(np.concatenate(faces), return_inverse=True)
    return lattice[used], again.reshape(-1, 3)


def capture(world, *, takes=3, after=0.15, seed=0, cells=4):
    """Return a capture of a cube of 4 boxes a side, and what it withholds; ``cells``: a side, of what is recorded."""
    rng = np.random.default_rng(seed)
    vertices, faces = cube_surface()
    mesh = body_mesh(vertices, faces, lattice=(cells,) * 3)
    rest = rng.uniform(-0.03, 0.03, size=(14, 3))
    worlds = SoftWorlds(mesh, 400.0, rest, threads=1)
    times = np.arange(0, 0.25 + after, 1 / 200)
    starts = [
        State(
            time=-1e-6,
            place=np.array([0.0, 0.0, 0.42]),
            velocity=np.array([0.4 * i, -0.2, -0.3]),
            turn=Rotation.from_euler("xyz", [0.3 * i, 0.2 * i, 0.5]).as_matrix(),
            spin=rng.normal(size=3) * 3,
        )
        for i in range(takes)
    ]
    points, _ = worlds.run([SimulationJob(start=s, world=world, times=times) for s in starts])
    trials = []
    for i, truth in enumerate(points):
        seen = truth + SIGMA * rng.normal(size=truth.shape)
        shown = 40 if i == takes - 1 else len(times)
        trials.append(
            Trial(
                name=f"take{i}",
                role="fit" if shown == len(times) else "predict",
                times=times[:shown],
                points=seen[:shown],
                pixels=None,
                object_index=np.zeros(14, dtype=np.int64),
                rest_points=rest,
                predict_times=None if shown == len(times) else times[shown:],
            )
        )
    belief = ObjectBelief(
        name="body", mesh="body.obj", density_kg_m3=400.0, stiffness="soft", youngs_modulus_pa=8e4, poisson_ratio=0.3
    )
    made = Capture(
        gravity=(0.0, 0.0, -9.81),
        ground=Ground(friction=0.4),
        objects=(CaptureObject(belief=belief, vertices=vertices, faces=faces),),
        noise_sigma=SIGMA,
        camera=None,
        trials=tuple(trials),
    )
    return made, points[-1][shown:]


def fits(made, names):
    return fit_soft(made, names, on_event=lambda event: None, cancelled=lambda: False)


def test_the_surface_gives_its_lattice_away():
    assert body_mesh(*cube_surface(cells=5)).lattice == (5, 5, 5)


@pytest.mark.parametrize("away", [False, True])
def test_the_cells_are_divided_as_the_surface_is(away):
    vertices, faces = cube_surface(away=away)
    mesh = body_mesh(vertices, faces)
    nearest = np.linalg.norm(vertices[:, None] - mesh.nodes, axis=2).argmin(axis=1)
    assert {tuple(f) for f in np.sort(nearest[faces], axis=1)} == {tuple(f) for f in mesh.faces()}
    assert mesh.volumes.sum() == pytest.approx(0.06**3)
    assert mesh.node_areas().sum() == pytest.approx(6 * 0.06**2)


@pytest.mark.parametrize("turn", [(0.6, 0.4, 0.5), (0.3, 0.2, 0.5), (0.0, 0.0, 0.5)])
def test_no_bounce_gains_energy(turn):
    mesh = body_mesh(*cube_surface())
    worlds = SoftWorlds(mesh, 400.0, mesh.nodes, threads=1)
    start = State(
        time=-1e-6,
        place=np.array([0.0, 0.0, 0.42]),
        velocity=np.array([0.8, -0.2, -0.3]),
        turn=Rotation.from_euler("xyz", turn).as_matrix(),
        spin=np.array([5.40490461, 3.94531129, 1.07214123]),
    )
    world = dataclasses.replace(NOMINAL, factor=0.55)
    times = np.arange(0, 0.38, 1 / 200)
    (points,), _ = worlds.run([SimulationJob(start=start, world=world, times=times)])
    share = worlds.masses / worlds.masses.sum()
    place = np.einsum("n,tni->ti", share, points)
    speed = (place[-1] - place[-3]) * 100
    tensor = worlds.inertia.tensor / worlds.inertia.mass
    spin = start.turn.T @ start.spin
    before = 9.81 * 0.42 + 0.5 * start.velocity @ start.velocity + 0.5 * spin @ tensor @ spin
    assert 9.81 * place[-2, 2] + 0.5 * speed @ speed < 1.005 * before
    assert speed[2] > 0.5


def test_rigid_fallback_when_a_world_fails(monkeypatch):
    made, _ = capture(NOMINAL, takes=1)
    mesh = body_mesh(made.objects[0].vertices, made.objects[0].faces)
    worlds = SoftWorlds(mesh, 400.0, made.trials[0].rest_points, threads=1)
    flights = Flights([soft_trial(made.trials[0], GroundFrame(made), mesh.nodes)], worlds, SIGMA)
    times = made.trials[0].predict_times
    monkeypatch.setattr(worlds, "run", lambda jobs, **_: ([np.full((len(j.times), 14, 3), np.nan) for j in jobs], []))
    assert np.isnan(flights.motion([0], [NOMINAL], [times])[0]).any()
    (found,) = flights.lasting_motion([0], [NOMINAL], [times])
    assert found.shape == (len(times), 14, 3)
    assert np.isfinite(found).all() and found[:, :, 2].min() >= 0


@pytest.mark.parametrize(
    ("name", "world", "parameter", "truth"),
    [
        ("buoyancy", dataclasses.replace(NOMINAL, gravity=(0.0, 0.0, -8.0)), "fraction", 1 - 8.0 / 9.81),
        ("air_drag", dataclasses.replace(NOMINAL, drag=0.3), "drag_per_mass", 0.3),
        ("time_scale", NOMINAL, "rate", 1.0),
    ],
)
def test_flights_alone_find_what_acts_in_flight(name, world, parameter, truth):
    made, _ = capture(world, takes=3, after=0.0)
    mesh = body_mesh(made.objects[0].vertices, made.objects[0].faces)
    frame = GroundFrame(made)
    takes = [soft_trial(t, frame, mesh.nodes) for t in made.trials]
    flights = Flights(takes, SoftWorlds(mesh, 400.0, made.trials[0].rest_points, threads=1), SIGMA)
    (candidate,) = candidates(NOMINAL, 0.03, np.array([0, 0, 0.4]))[name]
    found = fit_in_flight(flights, [0, 1, 2], NOMINAL, candidate)
    spread = float(found.curvatures.sum(axis=0)[0, 0]) ** -0.5
    assert candidate.values(found.free)[parameter] == pytest.approx(truth, abs=max(4 * spread, 2e-3))
    count = sum(flights.fit(i, NOMINAL).count for i in range(3))
    assert found.chi2.sum() == pytest.approx(count, rel=0.1)


@pytest.mark.slow
def test_a_softer_body_is_found_predicted_and_placed():
    made, withheld = capture(dataclasses.replace(NOMINAL, factor=0.55))
    found = fits(made, ["stiffness", "internal_damping", "friction", "buoyancy"])
    best = found.candidates[0]
    assert best.effects == ("stiffness",)
    assert best.parameters["stiffness"]["factor"].value == pytest.approx(0.55, rel=0.06)
    assert best.log_evidence > found.refitted.log_evidence + 20
    assert best.misfit < 1.2 < found.nominal.misfit
    after = found.predict(best)["take2"] - withheld
    before = found.predict(found.nominal)["take2"] - withheld
    assert np.sqrt((after**2).mean()) < 0.3 * np.sqrt((before**2).mean())
    for name, where in found.discrepancy(best).items():
        trial = next(t for t in made.trials if t.name == name)
        flying = trial.times < 0.18
        assert where.frame_score[flying].max() < 1e-6
        if trial.role == "fit":
            assert where.frame_score[~flying].max() > 10
        assert sum(where.directions.values()) == pytest.approx(1)


@pytest.mark.slow
def test_no_effect_is_found_in_plain_motion():
    made, _ = capture(NOMINAL, seed=1)
    found = fits(made, ["stiffness", "internal_damping", "friction", "buoyancy"])
    assert found.nominal.misfit < 1.1
    assert max(c.log_evidence for c in found.candidates) < found.refitted.log_evidence + 3


def test_a_lattice_that_is_too_stiff_is_no_cause():
    """A cube of four boxes a side is stiffer than one of nine, by what the two lattices of the survey leave open."""
    made, _ = capture(NOMINAL, after=0.05, cells=9)
    survey = Survey(made, on_event=ignore, cancelled=never, work=Work())
    neutral = CandidateSearch(survey.problem, None)
    plain = neutral.descend(neutral.try_all([neutral.mean])[0], 4, never)
    assert -3 * survey.problem.modulus_spread < plain.free[-1] < 0
    (stiffness,) = candidates(NOMINAL, 0.03, np.zeros(3))["stiffness"]
    search = CandidateSearch(survey.problem, stiffness)
    found = search.descend(search.try_all([np.array([-0.03, *plain.free[:2], 0.0])])[0], 4, never)
    assert search.log_evidence(found) < neutral.log_evidence(plain) + 3


def test_parameters_are_as_sure_as_trials_that_share_errors_and_two_lattices_make_them():
    made, _ = capture(dataclasses.replace(NOMINAL, factor=0.8), after=0.02)
    survey = Survey(made, on_event=ignore, cancelled=never, work=Work())
    (stiffness,) = candidates(NOMINAL, 0.03, np.zeros(3))["stiffness"]
    one = survey.problem
    four = dataclasses.replace(one, windows=list(one.windows) * 4)
    searches = [CandidateSearch(problem, stiffness) for problem in (one, four)]
    free = np.array([np.log(0.8), 0.0, 0.0, 0.0])
    fit, repeated = (search.with_jacobians(search.try_all([free])[0]) for search in searches)
    # Four times the same trials, sharing their errors, are worth one.
    shared = searches[1].covariance(repeated)
    assert np.allclose(shared, np.linalg.inv(searches[0].normal_equations(fit)[1]), rtol=1e-6, atol=0)
    assert 1e-4 < np.sqrt(shared[0, 0]) < 0.05
    moved = np.array([-0.03, 9.0, 0.0, 0.0])
    added = searches[1].covariance(repeated, moved) - shared
    assert np.allclose(added, np.diag([(0.03 / 1.96) ** 2, searches[1].spread[1] ** 2, 0.0, 0.0]), atol=1e-12)


def test_unsupported_captures_are_reported():
    made, _ = capture(NOMINAL, after=0.0)
    rigid = dataclasses.replace(made.objects[0].belief, stiffness="hard", youngs_modulus_pa=None)
    with pytest.raises(InputError, match="rigid"):
        fits(dataclasses.replace(made, objects=(dataclasses.replace(made.objects[0], belief=rigid),)), None)
    with pytest.raises(InputError, match="one"):
        fits(dataclasses.replace(made, objects=made.objects * 2), None)
    filmed = [dataclasses.replace(t, points=None, pixels=t.points[..., :2]) for t in made.trials]
    with pytest.raises(InputError, match="give it a rigid material"):
        fits(dataclasses.replace(made, trials=tuple(filmed)), None)
    with pytest.raises(Cancelled):
        fit_soft(made, None, on_event=lambda event: None, cancelled=lambda: True)
