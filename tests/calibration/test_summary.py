# Licensed under a 3-clause BSD style license - see LICENSE
"""Every line of a summary from numbers made up for it, and the same numbers for machines."""

from types import SimpleNamespace

import astropy.units as u
import numpy as np
from astropy.modeling.fitting import TRFLSQFitter
from astropy.table import QTable

from astropolcal.calibration import calibrate
from astropolcal.calibration.result.summary import (
    _accuracy_lines,
    _bound_lines,
    _goodness_lines,
    _heading,
    _rows,
    _standard_lines,
    _target_row,
    _wavelength_blocks,
    _wrap,
    mirror_lines,
    open_lines,
    open_on_sky,
    star_lines,
)
from astropolcal.calibration.result.verdict import parameter_lines
from astropolcal.calibration.uncertainty.covariance import status_of
from astropolcal.measurement.parameters import element_names


def _entry(value, std=np.nan, unit=None, **flags):
    shape = np.shape(value)
    known = {"value": np.asarray(value, float), "std": np.broadcast_to(std, shape), "unit": unit}
    known |= {"fixed": False, "tied": None, "at_bound": np.zeros(shape, bool), "bounds": (0, 2)}
    known |= {key: np.full(shape, np.nan) for key in ("std_inward", "std_released")}
    known |= {"identifiable": np.isfinite(known["std"]), "conditional_on": np.full(shape, "")}
    return known | flags | {"status": status_of(known | flags)}


def _accuracy(n=3, **columns):
    names = ("s_res", "s_mean", "s_cv", "s_standard")
    values = {name: columns.get(name, np.full(n, np.nan)) * u.percent for name in names}
    return QTable({"wavelength": np.linspace(1200, 2200, n) * u.nm, **values})


def _record(name="night", n_masked=0, source=None, **columns):
    own = {"name": name, "n_frames": 16, "n_masked": n_masked, "source": source}
    return SimpleNamespace(**own, accuracy=_accuracy(**columns))


def _calibration(**changes):
    made = {
        "instrument": "lab",
        "converged": True,
        "covariance": range(7),
        "datasets": [_record()],
        "wavelength": np.linspace(1200, 2200, 3) * u.nm,
        "settings": {"strategy": "joint", "fitter": "F", "observable": "normalized_difference"},
        "fit": {"n_data": 48, "seconds": 1.234},
        "at_bound": [],
    }
    return SimpleNamespace(**made | changes)


AT = np.array(True)


# --- lines ------------------------------------------------------------------------------------


def test_long_lines_are_broken_behind_their_bullet():
    long = "  - " + "word " * 30
    lines = _wrap(_calibration(), [long, "short", ""])
    assert all(len(line) <= 80 for line in lines)
    assert lines[0].startswith("  - word")
    assert lines[1].startswith("    word")
    assert lines[-2:] == ["short", ""]
    assert " ".join(" ".join(lines).split()) == " ".join((long + " short").split())
    # elements in words are named by their wavelength
    (words,) = _wrap(_calibration(), ["hwp.retardance[1] by +1 deg, a.b[9]"])
    assert words == "hwp.retardance (1700.0 nm) by +1 deg, a.b[9]"


def test_heading():
    for converged, instrument, words in [
        (True, "lab", ["Calibration of lab from night", "F, 1.23 s, converged"]),
        (False, None, ["Calibration of an instrument from night", "F, 1.23 s, NOT CONVERGED"]),
    ]:
        lines = _heading(_calibration(converged=converged, instrument=instrument))
        assert [lines[0], lines[2]] == words, (converged, instrument)
        assert lines[1] == "joint fit of 7 parameters to 48 normalized differences,", (
            converged,
            instrument,
        )


def test_a_parameter_for_all_wavelengths():
    for entry, words in [
        (_entry(1.5, 0.25, u.deg), "     1.50000 +- 0.25000 deg"),
        (_entry(0.5, 0.025), "     0.50000 +- 0.02500"),
        (_entry(1.5, 12.0, u.deg), "     1.50000 +- 12 deg (badly determined)"),
        (_entry(2.0, unit=u.deg, at_bound=AT), "     2.00000 deg (at its bound)"),
        (
            _entry(2.0, unit=u.deg, at_bound=AT, std_inward=0.5),
            "     2.00000 deg (at its bound; above 1.50)",
        ),
        (
            _entry(0.0, unit=u.deg, at_bound=AT, std_inward=0.0123),
            "     0.00000 deg (at its bound; below 0.012)",
        ),
        (
            _entry(0.0, unit=u.deg, at_bound=AT, std_inward=np.inf),
            "     0.00000 deg (at its bound; not limited)",
        ),
        (_entry(1.5, np.nan, u.deg), "     1.50000 deg (open: not determined alone)"),
        (_entry(1.5, 0.25, u.deg, tied="b.c"), "     1.50000 deg (follows b.c)"),
    ]:
        (line,) = parameter_lines({"a.theta": entry}, several=False)
        assert line == f"  {'a.theta':<28}{words}"
    # fixed ones and those of a wavelength are not among them
    known = {"a.b": _entry(1.0, fixed=True), "c.d": _entry([1.0, 2.0], [0.01, np.nan])}
    assert parameter_lines(known, several=False) == []
    (line,) = parameter_lines(known)
    assert line.split() == ["c.d", *"1.0000 to 2.0000 +- 0.01 (1 open)".split()]


def test_what_is_conditional_says_on_what_and_what_it_is_else():
    hanging = {"conditional_on": "calibration_polarizer.theta", "std_released": np.array(0.25)}
    lines = parameter_lines({"derotator.theta": _entry(1.5, 0.125, u.deg, **hanging)})
    assert " ".join(" ".join(lines).split()) == (
        "derotator.theta 1.50000 +- 0.12500 deg (conditional on calibration_polarizer.theta at its "
        "bound; without it 0.25)"
    )
    assert all(len(line) <= 80 for line in lines)


# --- accuracies ---------------------------------------------------------------------------------


def test_median_best_and_worst_leave_out_what_is_not_known():
    values = np.array([3.0, -1.0, np.nan, 2.0, np.inf])
    head, median, best, worst = _rows({"a": values, "b": [np.nan]})
    assert head.split() == ["a", "b"]
    # a bias may be negative: its size counts
    assert median.split() == ["median", "2.000", "-"]
    assert best.split() == ["best", "1.000", "-"]
    assert worst.split() == ["worst", "3.000", "-"]


def test_accuracy_of_a_dataset_says_what_is_masked_and_why():
    lines = _accuracy_lines(
        _record(n_masked=5, s_res=np.array([1.0, 2, 3])), {"cloud": 3, "hot": 2}
    )
    assert lines[0] == "Accuracy on night, in percent of polarization"
    assert lines[2].split() == ["median", "2.000", "-", "-", "-"]
    assert lines[-1] == "  (16 frames x 3 wavelengths, 5 cells masked; cloud: 3; hot: 2)"
    assert _accuracy_lines(_record(), {})[-1] == "  (16 frames x 3 wavelengths)"
    # a table from before a column existed
    record = _record(s_res=np.ones(3))
    record.accuracy.remove_column("s_standard")
    assert _accuracy_lines(record, {})[2].split()[-1] == "-"


def test_a_standard_shows_its_prediction():
    keys = ("s_standard_percent", "bias_percent", "scatter_percent", "s_cv_percent", "chi")
    entry = {key: [0.5, None, 1.5] for key in keys} | {"bias_percent": [-0.4, -0.2, 0.1]}
    entry |= {"name": "star", "words": "errors 1 times s_cv", "n_frames": 8, "n": [4, 0, 4]}
    lines = _standard_lines(entry)
    assert lines[0] == "Prediction of star (not fitted), in percent"
    assert lines[1].split() == ["s_standard", "|bias|", "scatter", "s_cv", "/", "s_cv"]
    assert lines[2].split() == ["median", "1.000", "0.200", "1.000", "1.000", "1.000"]
    assert lines[-1] == "  errors 1 times s_cv (8 frames x 3 wavelengths)"


# --- parameters per wavelength -----------------------------------------------------------------


def test_a_row_a_wavelength_with_errors_and_what_stands_for_them():
    known = {
        "hwp.retardance": _entry(
            [10.0, 20.0, 30.0], [0.1, np.nan, np.nan], u.deg, at_bound=np.array([0, 1, 0], bool)
        ),
        "w.efficiency": _entry([0.9, 0.95, 1.0], [0.01, 0.1, 5e3]),
        "m.theta": _entry([1.0, 2.0, 3.0], 0.1, u.deg, std_released=np.array([np.nan, 1, np.inf])),
        "hwp.theta": _entry(1.0),
        "held.retardance": _entry([1.0, 2.0, 3.0], fixed=True),
        "a.b": _entry([1.0, 2.0, 3.0], tied="c.d"),
    }
    cal = _calibration(datasets=[_record(s_mean=np.array([0.1, np.nan, 0.3]))])
    first, second = _wavelength_blocks(cal, known)
    title, optics, keys, units, *rows = first
    assert "? badly determined, c conditional on a bound" in title
    assert optics.split() == ["hwp", "w", "m"]
    assert keys.split() == ["s_mean", "retardance", "efficiency", "theta"]
    assert units.split() == ["nm", "%", "deg", "deg"]
    assert [" ".join(row.split()) for row in rows] == [
        "1200.0 0.100 10.00 +- 0.10 0.9000 +- 0.0100 1.00 +- 0.10",
        "1700.0 - 20.00 bound 0.9500 +- 0.1000? 2.00 +- 0.10 c",
        "2200.0 0.300 30.00 open 1.0000 +- 5e+03 ? 3.00 +- 0.10 c",
    ]
    # what follows another parameter has no error of its own
    assert [row.split()[2:] for row in second[-3:]] == [["1.0000"], ["2.0000"], ["3.0000"]]
    assert all(len(line) <= 80 for line in (*first, *second))


def test_all_parameters_are_shown_in_as_many_blocks_as_it_takes():
    known = {f"o{i}.p": _entry([1.0, 2.0, 3.0], 0.01) for i in range(7)}
    blocks = list(_wavelength_blocks(_calibration(), known))
    heads = [block[-6].split() for block in blocks]
    assert heads == [["o0", "o1", "o2"], ["o3", "o4", "o5"], ["o6"]]
    assert all(len(line) <= 80 for block in blocks for line in block)
    assert list(_wavelength_blocks(_calibration(), {"a.b": _entry(1.0)})) == []


def test_each_wavelength_has_the_accuracy_of_the_first_dataset_that_has_it():
    values = np.array([[0.1, np.nan, np.nan], [0.7, 0.2, np.nan]])
    cal = _calibration(datasets=[_record(s_mean=row) for row in values])
    (block,) = _wavelength_blocks(cal, {"a.b": _entry([1.0, 2.0, 3.0], 0.01)})
    assert [row.split()[1] for row in block[-3:]] == ["0.100", "0.200", "-"]
    # and none where the first table lacks it
    cal = _calibration(wavelength=[1000, 1200] * u.nm)
    cal.datasets[0].accuracy["s_mean"] = [0.1, 0.2, 0.3] * u.percent
    (block,) = _wavelength_blocks(cal, {"a.b": _entry([1.0, 2.0])})
    assert [row.split()[:2] for row in block[-2:]] == [["1000.0", "-"], ["1200.0", "0.100"]]


# --- goodness, bounds, stars ---------------------------------------------------------------------


def _outlier(i):
    return {
        "frames": f"{i}, {i + 1}",
        "dataset": "night",
        "residual_percent": -0.5 * i,
        "sigma": 6.6,
        "brightness": 0.25,
    }


def test_some_outliers_are_named_and_the_others_counted():
    for count, more in [(1, None), (5, None), (6, 1), (9, 4)]:
        cal = _calibration(fit={"outliers": [_outlier(i) for i in range(count)]})
        text = " ".join(" ".join(_goodness_lines(cal)).split())
        assert text.startswith("- frames 0, 1 of night are at odds with the fit"), (
            count,
            more,
        )
        assert text.count("robust sigma, brightness 0.25") == min(count, 5), (count, more)
        assert ("more pairs at odds with the fit" in text) == (more is not None), (count, more)
        if more:
            assert f"- and {more} more pairs" in text, (count, more)


def _rows_of(known):
    """Return the rows of the elements, as `Calibration.parameters` has them."""
    keys = ("value", "std", "at_bound", "std_inward", "status", "conditional_on", "std_released")
    return [
        {"name": label} | {key: np.ravel(entry[key])[i] for key in keys}
        for name, entry in known.items()
        for i, label in enumerate(element_names(name, np.size(entry["value"])))
    ]


def test_nothing_tested_nothing_said():
    assert _goodness_lines(_calibration()) == []
    known = {"a.b": _entry(1.0, 0.1)}
    assert _bound_lines(_rows_of(known), known) == []


def test_what_is_at_a_bound_and_what_hangs_on_it():
    at = np.array([True, False, False])
    hanging = {"conditional_on": np.array(["", "w.eff[0]", "w.eff[0]"])}
    hanging["std_released"] = np.array([np.nan, 0.02, 0.05])
    known = {
        "a.theta": _entry(2.0, unit=u.deg, at_bound=AT, std_inward=np.array(0.5)),
        "w.eff": _entry([2.0, 1.0, 1.0], 0.01, at_bound=at, std_inward=np.full(3, np.inf)),
        "b.q": _entry([1.0, 1.0, 1.0], 0.01, **hanging),
    }
    lines = _wrap(_calibration(), _bound_lines(_rows_of(known), known))
    assert all(len(line) <= 80 for line in lines)
    assert " ".join(" ".join(lines).split()) == (
        "- a.theta: above 1.50 - w.eff (1200.0 nm): not limited - the "
        "error of b.q at 2 wavelengths is conditional on w.eff (1200.0 nm) at its bound; without "
        "it 2 to 5 times as large"
    )


def test_row_of_a_target_has_a_dash_for_what_is_not_known():
    columns = {key: [0.2, 0.2, np.inf] for key in ("s_Q", "s_U", "s_p")}
    table = QTable({key: value * u.percent for key, value in columns.items()})
    table["s_chi"] = np.full(3, np.nan) * u.deg
    table.meta |= {"aolp": None, "dolp": 0.1 * u.percent}
    assert _target_row(table).split() == ["0.1", "%", "any", "0.2", "0.2", "0.2", "inf", "-", "-"]


# --- what is left open on sky, mirrors -----------------------------------------------------------


def _direction(words, turn=None, gain=0.0):
    sky = {} if turn is None else {"sky": {"aolp_deg": [turn, turn], "dolp_percent": [gain, gain]}}
    return {"words": words, "parameters": {}} | sky


def _with_directions(directions, near_null=()):
    finding = SimpleNamespace(directions=list(directions), near_null=list(near_null))
    return _calibration(identifiability=finding)


def test_what_is_open_on_sky_is_said_of_the_worst_first():
    cal = _with_directions(
        [
            _direction("a.b by +1 deg cannot be distinguished from c.d by +1 deg; on sky", 0.5),
            _direction("e.f by +1 deg cannot be distinguished from g.h by +1 deg; on sky", -2.0),
            _direction("i.j by +1 deg cannot be distinguished from g.h by +1 deg; on sky", 0.001),
            _direction("k.l changes no datum: it cannot be determined"),
        ],
        [_direction("m.n is uncertain by 7 deg at the noise of this fit; on sky", 0.3, 0.02)],
    )
    found = open_on_sky(cal)
    assert [(one["kind"], one["aolp_deg"][0]) for one in found] == [
        ("open", -2.0),
        ("open", 0.5),
        ("badly determined", 0.3),
    ]
    assert open_lines(cal) == [
        "  infinite, because the data do not determine: e.f by +1 deg: "
        "on sky the AoLP changes by up to 2 "
        "deg and the DoLP by less than 0.01 % of itself, regardless of the DoLP; a.b by +1 deg: "
        "on sky the AoLP changes by up to 0.5 deg and the DoLP by less than 0.01 % of "
        "itself, regardless of the DoLP",
        "  large, because of badly determined directions: m.n is uncertain by 7 deg: "
        "on sky the AoLP changes by up to 0.3 deg and the DoLP by up to 0.02 % of itself, "
        "regardless of the DoLP",
    ]
    # many open directions are counted
    cal = _with_directions(
        _direction(f"a.b{i} by +1 deg cannot be distinguished", 1.0) for i in range(5)
    )
    assert open_lines(cal)[0].endswith("; and 2 more, see below")
    assert open_lines(_with_directions([])) == []


def test_mirrors_at_all_of_a_few_wavelengths(monkeypatch):
    from astropolcal.calibration.result import summary as _sky_summary

    for n, shown, says in [(7, 7, None), (12, 12, None), (22, 5, 5)]:

        def values(calibration, name, n=n):
            keys = ["diattenuation", "diattenuation_err"]
            keys += [f"diattenuation_{metal}" for metal in _sky_summary.METALS]
            return QTable({key: np.ones(n) * u.percent for key in keys}, meta={"name": name})

        monkeypatch.setattr(_sky_summary, "mirror_names", lambda calibration: ["m3"])
        monkeypatch.setattr(_sky_summary, "mirror_values", values)
        title, _, *rows = mirror_lines(_calibration(wavelength=np.linspace(600, 800, n) * u.nm))
        assert len(rows) == shown, (n, shown, says)
        assert title.endswith(f"one in {says} of {n} wavelengths" if says else "at 45 deg"), n


def test_a_mirror_unlike_any_metal_is_pointed_at(monkeypatch):
    for percent, std, says in [
        ([1.0, 1.0], [0.1, 0.1], None),
        # 3 times the 1.2 % of the worst metal is 3.6 %
        ([3.7, -4.9], [0.01, 0.5], "m3: 3.70 % at 600.0 nm is more than 3 times"),
        ([3.7, -4.9], [0.01, 0.1], "m3: -4.90 % at 800.0 nm is more than 3 times"),
        # what is open says nothing, what is held has no error
        ([50.0, 1.0], [np.inf, 0.1], None),
        ([50.0, 1.0], [np.nan, 0.1], "m3: 50.00 % at 600.0 nm"),
    ]:
        from astropolcal.calibration.result import summary as _sky_summary

        columns = {"wavelength": [600, 800] * u.nm, "diattenuation": percent * u.percent}
        columns |= {"diattenuation_err": std * u.percent}
        metals = {
            f"diattenuation_{metal}": [0.5, -1.2] * u.percent for metal in _sky_summary.METALS
        }
        metals["diattenuation_gold"] = [1.2, 0.3] * u.percent
        table = QTable(columns | metals, meta={"name": "m3"})
        monkeypatch.setattr(_sky_summary, "mirror_names", lambda calibration: ["m3"])
        monkeypatch.setattr(_sky_summary, "mirror_values", lambda calibration, name, t=table: t)
        lines = mirror_lines(_calibration(wavelength=[600, 800] * u.nm))
        # the table, and a sentence that is broken like the rest of the summary
        assert " ".join(lines[4:]).startswith(says or "")
        assert bool(lines[4:]) is bool(says)
        assert all(len(line) <= 80 for line in lines)


# --- stars ---------------------------------------------------------------------------------------


def test_a_star_beside_its_catalogue():
    keys = [
        f"{k}{s}"
        for k in ("dolp", "dolp_known", "dolp_err", "dolp_known_err")
        for s in ("_percent",)
    ]
    keys += [f"{k}_deg" for k in ("aolp", "aolp_known", "aolp_err", "aolp_known_err")]
    entry = {key: [1.23456, np.nan] for key in keys} | {"star": "HD 1", "name": "night"}
    entry |= {"wavelength_nm": [1200.0, 1600.0], "aolp_known_err_deg": [np.nan, np.nan]}
    title, head, first, second = star_lines(entry)
    assert title == "HD 1 against the catalogue; no fit saw night"
    assert head.split() == ["nm", "DoLP", "(%)", "catalogue", "AoLP", "(deg)", "catalogue"]
    assert " ".join(first.split()) == "1200.0 1.235 +- 1.235 1.235 +- 1.235 1.2 +- 1.2 1.2"
    assert second.split() == ["1600.0", "-", "-", "-", "-"]


# --- all at once ----------------------------------------------------------------------------------


def test_what_was_fitted_is_only_shown(make, monkeypatch, tmp_path):
    """No fit, however often and in which form a calibration is written."""
    lam = [1200, 1600, 2200] * u.nm
    chain = make.chain(wavelength=lam)
    cal = calibrate(chain, make.observe(chain, wavelength=lam), search=False)

    def fit(*args, **kwargs):
        raise AssertionError("a serializer fits")

    monkeypatch.setattr("scipy.optimize.least_squares", fit)
    monkeypatch.setattr(TRFLSQFitter, "__call__", fit)
    for _ in range(2):
        assert cal.summary(full=True)
        assert cal.to_dict()["verdict"]
        cal.write(tmp_path / "cal.asdf", overwrite=True)
