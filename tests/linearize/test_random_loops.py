"""200 random loops with one to three delays: stability and margins against the argument principle on a fine contour, and simulations."""

from dataclasses import dataclass
from functools import cache

import numpy as np
import pytest

import hvdc_ident as hi

pytestmark = pytest.mark.nightly

STATES = range(3)
OMEGA = np.concatenate([np.linspace(0.0, 200.0, 40_001), np.geomspace(200.0, 1e6, 4001)[1:]])
"""rad/s; the steps turn the longest delay by less than 0.01 rad where the loops have a gain that matters."""


@dataclass(frozen=True)
class RandomLoop:
    """x' = A x + B e + sum D_k v_k with v_k = C_k x(t - T_k), e = r - k y and y = C x + sum F_k v_k."""

    a: np.ndarray
    b: np.ndarray
    c: np.ndarray
    into: np.ndarray
    of: np.ndarray
    direct: np.ndarray
    times: np.ndarray
    k: float

    @classmethod
    def of_seed(cls, seed):
        rng = np.random.default_rng(seed)
        delays = 1 + seed % 3
        return cls(
            rng.normal(size=(3, 3)) - rng.uniform(0.5, 3.0) * np.eye(3), rng.normal(size=3), rng.normal(size=3),
            0.8 * rng.normal(size=(3, delays)), 0.8 * rng.normal(size=(delays, 3)), 0.3 * rng.normal(size=delays),
            rng.uniform(0.05, 1.5, delays), 10 ** rng.uniform(-1.0, 0.7),
        )  # fmt: skip

    def unstable(self, factor=1.0, late=0.0):
        """Roots right of the axis with a factor and a delay on the loop's gain, None where the contour meets one.

        det(s - A - sum E_k D_k C_k + k e^(-s late) B (C + sum F_k E_k C_k)) over (s + 1)^3 has no pole right of the axis and
        goes to 1 at infinity: its phase from 0 to infinity changes by -pi for each of its zeros there.
        """
        s = 1j * OMEGA
        e = np.exp(-s[:, None] * self.times)
        shown = self.c + (self.direct * e) @ self.of
        m = s[:, None, None] * np.eye(3) - self.a - np.einsum("ik,wk,kj->wij", self.into, e, self.of)
        m = m + (factor * self.k * np.exp(-s * late))[:, None, None] * self.b[:, None] * shown[:, None, :]
        cofactors = np.cross(m[:, 1], m[:, 2])
        value = (m[:, 0] * cofactors).sum(axis=1) / (s + 1.0) ** 3
        steps = np.angle(value[1:] / value[:-1])
        count = -(steps.sum() + np.angle(1.0 / value[-1])) / np.pi
        if np.abs(steps).max() > 0.5 or abs(count - round(count)) > 1e-2:
            return None
        return round(count)

    @property
    def model(self):
        values = {f"a{i}{j}": self.a[i, j] for i in STATES for j in STATES} | {"k": self.k}
        values |= {f"b{i}": self.b[i] for i in STATES} | {f"c{i}": self.c[i] for i in STATES}
        for n, time in enumerate(self.times):
            values |= {f"T{n}": time, f"f{n}": self.direct[n]}
            values |= {f"d{i}{n}": self.into[i, n] for i in STATES} | {f"of{n}{i}": self.of[n, i] for i in STATES}
        return template(len(self.times)).with_values({n: float(v) for n, v in values.items()})


@cache
def template(delays):
    """Return the model whose parameters are all the numbers: one structure, compiled once."""
    ks = range(delays)
    names = [f"a{i}{j}" for i in STATES for j in STATES] + [f"{n}{i}" for n in "bc" for i in STATES] + ["k"]
    names += [f"f{n}" for n in ks] + [f"{p}" for n in ks for i in STATES for p in (f"d{i}{n}", f"of{n}{i}")]
    parameters = {n: {"value": 1.0} for n in names} | {f"T{n}": {"value": 1.0, "unit": "s"} for n in ks}

    def rate(i):
        own = [f"a{i}{j}*x{j}" for j in STATES] + [f"b{i}*e"] + [f"d{i}{n}*v{n}" for n in ks]
        return " + ".join(own)

    return hi.Model(
        name=f"loop-with-{delays}-delays",
        parameters=parameters,
        inputs={"r": 0.0},
        states={f"x{i}": rate(i) for i in STATES},
        signals={"y": " + ".join([f"c{i}*x{i}" for i in STATES] + [f"f{n}*v{n}" for n in ks]), "e": "r - k*y"},
        delays={f"v{n}": {"of": " + ".join(f"of{n}{i}*x{i}" for i in STATES), "time": f"T{n}"} for n in ks},
        outputs={"out": "y"},
    )


def assert_edge(of, at, side):
    """The loop is stable a little before the factor or delay `at` and not a little behind it, seen from side 1 (rising) or -1."""
    before, behind = at * (1.0 - side * 1e-3), at * (1.0 + side * 1e-3)
    assert of(before) in (0, None) and of(behind) != 0, (at, of(before), of(behind))


@pytest.mark.parametrize("block", range(10))
def test_stability_and_margins_of_random_loops(block):
    seen = {0: 0, 1: 0}
    for seed in range(20 * block, 20 * block + 20):
        case = RandomLoop.of_seed(seed)
        want = case.unstable()
        if want is None:
            continue
        seen[min(want, 1)] += 1
        model = case.model
        point = hi.find_operating_point(model)
        found = hi.linear.margins(hi.linear.loop(model, "e", point))
        assert found.stability.unstable == want, seed
        assert found.stable == point.stable == (want == 0), seed
        if want:
            assert np.isnan([found.gain_margin.value, found.phase_margin.value, found.delay.value]).all()
            assert "not stable" in str(found) and found.to_dict()["disk_margin"]["value"] is None
            continue
        upper, lower = found.gain_margin.value, found.lower_gain_margin.value
        assert lower < 1.0 < upper
        if np.isfinite(upper):
            assert_edge(case.unstable, upper, 1)
        else:
            assert all(case.unstable(k) in (0, None) for k in (2.0, 10.0, 100.0)), seed
        if lower > 0.0:
            assert_edge(case.unstable, lower, -1)
        else:
            assert all(case.unstable(k) in (0, None) for k in (0.5, 0.1, 0.0)), seed
        if np.isfinite(found.delay.value):
            assert_edge(lambda late, case=case: case.unstable(1.0, late), found.delay.value, 1)
        assert found.disk.value > 0.0 and found.disk_gain <= min(upper, 1.0 / max(lower, 1e-300)) * (1.0 + 1e-6)
    assert sum(seen.values()) >= 18 and min(seen.values()) >= 3


@pytest.mark.parametrize("seed", [0, 4, 5, 8, 11, 16])
def test_random_loops_grow_where_a_root_does(seed):
    case = RandomLoop.of_seed(seed)
    found = hi.linearize(case.model).stability()
    t = np.linspace(0.0, 60.0, 6001)
    y = hi.simulate(case.model, t, inputs={"r": hi.step(0.0, 1.0, at=0.5)})["out"]
    early, late = (np.ptp(y[(t > a) & (t < a + 15.0)]) for a in (15.0, 45.0))
    assert (late > early) == (case.unstable() > 0) == (found.verdict == "unstable")
