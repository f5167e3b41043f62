# Licensed under a 3-clause BSD style license - see LICENSE
"""
Nodes of calibrations, and whether their parts belong together.

The node holds everything of a `~astropolcal.calibration.Calibration` but the measurement, so the
observations themselves stay outside. Its checksum covers all numbers and words, so that a file
either gives back what was written or is refused. A file of an older version of the schema is
checked against that version and its checksum, and then carried to the newest one step by step, see
``MIGRATIONS``.
"""

from importlib.metadata import version as installed

import astropy.units as u
import numpy as np

from astropolcal.calibration import Calibration
from astropolcal.calibration.identifiability.analysis import Identifiability
from astropolcal.calibration.result.calibration import DatasetRecord, validity_of
from astropolcal.calibration.uncertainty.covariance import Covariance
from astropolcal.chain import join, leaves
from astropolcal.converters import CALIBRATION_TAG, CALIBRATION_TAGS, nodes
from astropolcal.exceptions import AstropolcalError, CalibrationFileError
from astropolcal.files import one_line
from astropolcal.measurement.parameters import FreeParameters, Tie, are_outside, parameter_table
from astropolcal.observations.reading import stated_date
from astropolcal.version import version

__all__ = []


# what is written for those who look into the file, and worked out again on reading
_DERIVED = ("checksum", "validity", "written_with")
# what is written as it is
_PLAIN = ("at_bound", "settings", "fit", "provenance")


# ---- writing ---------------------------------------------------------------------


def node_from_calibration(calibration):
    """Return the node of a calibration, as the newest schema describes it."""
    node = _spelled(calibration)
    for optic in (optic for chain in node["chains"] for optic in chain["optics"]):
        nodes.refuse_foreign(optic)
    return node


def _spelled(calibration):
    """Return the node of a calibration, of any optics."""
    check_calibration(calibration)
    chains, posterior = calibration.chains, calibration.posterior
    covariance = calibration.covariance
    priors = nodes.node_from_priors(chains)
    # an optic's node cannot hold priors; copies: to write a calibration must not change it
    chains = [nodes.without_priors(chain) for chain in chains] if priors else chains
    node = {
        "chains": [{"optics": leaves(chain)} for chain in chains],
        "wavelength": nodes.node_from_value(calibration.wavelength),
        "covariance": {
            "names": list(covariance.names),
            "units": [nodes.unit_text(unit) for unit in covariance.units],
            "matrix": covariance.matrix.copy(),
        },
        "identifiability": _identifiability_node(calibration.identifiability),
        "datasets": [
            nodes.plain(vars(record) | {"accuracy": None}, record.name)
            | {"accuracy": nodes.node_from_table(record.accuracy)}
            for record in calibration.datasets
        ],
        "ties": [_tie_node(name, tie) for name, tie in calibration.ties.items()],
        "stages": [_stage_node(stage) for stage in calibration.stages],
        **{key: nodes.plain(getattr(calibration, key), key) for key in _PLAIN},
    }
    for chain, entry in zip(chains, node["chains"], strict=True):
        # a chain of one optic is that optic, which has its own name
        # astropy counts one submodel in a model that is no compound
        if chain.n_submodels > 1 and chain.name:
            entry["name"] = chain.name
    if covariance.factor is not None and covariance.factor.size:
        node["covariance"]["factor"] = covariance.factor.copy()
    if covariance.null is not None:
        # row by row: some versions of asdf cannot read an empty matrix
        node["covariance"]["open"] = [row.copy() for row in covariance.null]
    node |= {"priors": priors} if priors else {}
    node |= {} if posterior is None else {"posterior": nodes.node_from_posterior(posterior)}
    versions = {name: installed(name) for name in ("asdf", "asdf-astropy", "astropy")}
    return node | {
        "checksum": _checksum(node),
        "validity": {
            **validity_of(calibration).to_dict(),
            "dates": _dates(calibration),
            "optics_in_beam": [[leaf.name for leaf in leaves(chain)] for chain in chains],
        },
        "written_with": {"astropolcal": version} | versions,
    }


def _dates(calibration):
    """Return the dates of the datasets, oldest first."""
    dates = {stated_date(r.meta, r.name, CalibrationFileError) for r in calibration.datasets}
    return sorted(dates - {None})


def _checksum(node):
    return nodes.checksum({key: value for key, value in node.items() if key not in _DERIVED})


def _identifiability_node(finding):
    node = nodes.plain(vars(finding), "identifiability")
    # row by row: some versions of asdf cannot read an empty matrix
    node["null_vectors"] = [row.copy() for row in finding.null_vectors]
    for direction in (*node["directions"], *node["near_null"]):
        values = direction["parameters"].items()
        # a list, as a mapping would lose the order
        direction["parameters"] = [{"name": name, "value": value} for name, value in values]
    # absent where there are none, as in files of before
    return {key: value for key, value in node.items() if key != "branches" or value}


def _tie_node(name, tie):
    offset = nodes.node_from_value(tie.offset)
    return {"target": name, "source": tie.source, "factor": float(tie.factor), "offset": offset}


def _stage_node(stage):
    values = stage["parameters"].items()
    return {
        "title": stage["title"],
        "parameters": [{"name": name} | nodes.node_from_value(value) for name, value in values],
        "residual_rms": nodes.plain(stage["residual_rms"], "residual_rms"),
    }


# ---- reading ---------------------------------------------------------------------


def calibration_from_node(node, tag=CALIBRATION_TAG):
    """Return the calibration of a node with its optics restored, which obeys the schema ``tag``."""
    if _checksum(node) != node["checksum"]:
        raise CalibrationFileError(
            "the content does not match its checksum: it was changed after it was written"
        )
    # after the checksum, which is of the content as it was written
    for step in CALIBRATION_TAGS[CALIBRATION_TAGS.index(tag) : -1]:
        node = MIGRATIONS[step](node)
    chains = [join(entry["optics"]) for entry in node["chains"]]
    for chain, entry in zip(chains, node["chains"], strict=True):
        if "name" in entry:
            chain.name = entry["name"]
    # before the calibration is made: its free parameters bind the priors
    nodes.restore_priors(chains, node.get("priors", []))
    calibration = Calibration(
        chains=chains,
        wavelength=nodes.value_from_node(node["wavelength"]),
        covariance=_covariance(node["covariance"]),
        identifiability=_identifiability(node["identifiability"]),
        datasets=[
            DatasetRecord(
                **entry
                | {"meta": nodes.plain(entry["meta"])}
                | {"accuracy": nodes.table_from_node(entry["accuracy"])}
            )
            for entry in node["datasets"]
        ],
        ties={
            name: Tie(entry["source"], entry["factor"], nodes.value_from_node(entry["offset"]))
            for name, entry in nodes.by_name(node["ties"], "target").items()
        },
        stages=[_stage(entry) for entry in node["stages"]],
        **{key: nodes.plain(node[key]) for key in _PLAIN},
        posterior=nodes.posterior_from_node(node["posterior"]) if "posterior" in node else None,
    )
    check_calibration(calibration)
    _check_validity(calibration, node["validity"])
    return calibration


def _check_validity(calibration, told):
    """Refuse what somebody wrote into the copy for readers, which decides nothing."""
    held = validity_of(calibration).to_dict()
    if told.get("dates") != _dates(calibration):
        # of older software, which understood other dates
        return
    # optics in the beam hang on the instruments that are installed
    for key in ("instrument", "mode", "valid_from", "valid_until"):
        if told.get(key, held[key]) != held[key]:
            raise CalibrationFileError(
                f"validity: {key} = {one_line(repr(told[key]))}, but its content says "
                f"{held[key]!r}: it was changed after it was written; with_validity states it"
            )


def _to_1_1(node):
    """Version 1.0.0 knew no statement of validity: an entry of that name meant nothing."""
    settings = {key: value for key, value in node["settings"].items() if key != "validity"}
    return node | {"settings": settings}


#: Tag of an older version to the function that carries a node of it to the next one.
MIGRATIONS = {CALIBRATION_TAGS[0]: _to_1_1}


def _covariance(node):
    units = [nodes.unit_from_text(text) for text in node["units"]]
    shape = np.shape(node.get("factor", [[0.0] * len(units)]))
    if len(shape) != 2 or shape[1] != len(units):
        # it would be laid out anew, and mean something else
        raise CalibrationFileError(
            f"factor of the covariance has shape {shape}; (rank, {len(units)}) is needed"
        )
    return Covariance(
        node["names"],
        units,
        node["matrix"],
        factor=node.get("factor"),
        null=np.array(node["open"]) if "open" in node else None,
    )


def _identifiability(node):
    found, vectors = nodes.plain(node), node["null_vectors"]
    found["null_vectors"] = np.array(vectors) if vectors else np.zeros((0, len(node["names"])))
    for direction in (*found.setdefault("directions", []), *found.setdefault("near_null", [])):
        entries = nodes.by_name(direction["parameters"]).items()
        direction["parameters"] = {name: entry["value"] for name, entry in entries}
    return Identifiability(**found)


def _stage(node):
    entries = nodes.by_name(node["parameters"]).items()
    return {
        "title": node["title"],
        "parameters": {name: nodes.value_from_node(entry) for name, entry in entries},
        "residual_rms": node["residual_rms"],
    }


# ---- whether the parts of a calibration belong together ----


# in the unit of its declaration (degree, mm, nm, adu, none): far above all that an instrument has
_LARGEST = 1e15
_ACCURACY = ("wavelength", "n", "k", "s_res", "s_mean", "s_cv")
_MODEL_ERROR = {"wavelength_nm"} | {
    f"{sign}{key}_percent" for sign in ("", "sign_") for key in ("relative", "absolute")
}


def check_calibration(calibration):
    """Check shapes, names, units, bounds and shared values of a calibration against each other."""
    wavelength = calibration.wavelength
    if np.ndim(wavelength) != 1 or not np.all(wavelength.value > 0):
        raise CalibrationFileError(f"wavelength = {wavelength} must be a list of positive lengths")
    if len(calibration.chains) != len(calibration.datasets):
        raise CalibrationFileError(
            f"{len(calibration.chains)} chains but {len(calibration.datasets)} datasets"
        )
    try:
        free = FreeParameters(calibration.chains, len(wavelength), calibration.ties)
    except AstropolcalError as error:
        raise CalibrationFileError(str(error)) from None
    _check_optics(calibration, free)
    table = parameter_table(calibration.chains)
    for name in [*free.by_name, *free.ties]:
        # bit by bit: they were one number in the fit
        first, *others = (parameter.value for parameter in table[name])
        if not all(np.array_equal(first, other) for other in others):
            raise CalibrationFileError(f"{name} has different values in different datasets")
    _check_names("covariance", calibration.covariance.names, free.names)
    # a parameter with one value per wavelength has as many rows of the covariance
    for name, unit, expected in zip(
        free.names, calibration.covariance.units, free.units, strict=True
    ):
        if unit != expected:
            raise CalibrationFileError(f"covariance of {name} is in {unit}, allowed is {expected}")
    _check_identifiability(calibration.identifiability, free.names)
    errors = calibration.fit.get("model_error") or {}
    lengths = {len(one) for key, one in errors.items() if key in _MODEL_ERROR}
    if len(lengths) > 1 or not _finite([calibration.fit.get("sky_settings"), errors]):
        raise CalibrationFileError(
            "fit.sky_settings and fit.model_error must be finite, the latter of equal length"
        )
    unknown = sorted(set(calibration.at_bound) - set(free.names))
    if unknown:
        raise CalibrationFileError(f"at_bound names {unknown[0]!r}, which is not a free parameter")
    for record in calibration.datasets:
        if record.accuracy is not None:
            _check_accuracy(record.accuracy, f"the accuracy of {record.name}")
    nodes.check_posterior(calibration.posterior, calibration.covariance)


def _check_optics(calibration, free):
    """Refuse wavelengths at which an optic has no matrix, and values that no fit gives."""
    wavelength = calibration.wavelength
    for leaf in (leaf for chain in calibration.chains for leaf in leaves(chain)):
        # another unit is the schema's to refuse
        if wavelength.unit.is_equivalent("um"):
            try:
                leaf._dispersion(wavelength.to_value("um"))
            except AstropolcalError as error:
                raise CalibrationFileError(f"{leaf.name}: {error}") from None
        for key in leaf.param_names:
            name, parameter = f"{leaf.name}.{key}", getattr(leaf, key)
            bounds = [parameter.bounds]
            if name not in free.by_name:
                # the bounds of a fit do not matter to what is held or tied, those of the optic do
                bounds.append(leaf._declared(key).bounds)
            low = min(-_LARGEST if low is None else low for low, _ in bounds)
            high = max(_LARGEST if high is None else high for _, high in bounds)
            value = np.asarray(parameter.value, dtype=float)
            if are_outside(value, low, high).any():
                raise CalibrationFileError(
                    f"{name} = {one_line(parameter.value)} is outside of its bounds, "
                    f"{low:g} to {high:g}"
                )


def _check_names(what, names, expected):
    if len(names) != len(expected):
        raise CalibrationFileError(
            f"{what} of {len(names)} parameters, but {len(expected)} are free in the chains"
        )
    for name, other in zip(names, expected, strict=True):
        if name != other:
            raise CalibrationFileError(f"{what} of {name!r}, where {other!r} is free in the chains")


def _check_identifiability(finding, names):
    _check_names("identifiability", finding.names, names)
    n = len(names)
    shapes = {
        "singular_values": (n,),
        # rank and nullity add up to the number of parameters
        "null_vectors": (n - finding.rank, n),
        "identifiable": (n,),
    }
    for key, shape in shapes.items():
        found = np.shape(getattr(finding, key))
        if found != shape:
            raise CalibrationFileError(f"{key} have shape {found}, expected {shape}")
    if not _finite([finding.singular_values, finding.null_vectors]):
        raise CalibrationFileError("identifiability: its numbers must be finite")
    for direction in (*finding.directions, *finding.near_null):
        if not _finite(direction):
            words = one_line(direction["words"], 60)
            raise CalibrationFileError(f"identifiability: numbers of {words!r} must be finite")


def _finite(value):
    """Return whether all numbers of a tree are."""
    if isinstance(value, dict | list | tuple):
        return all(map(_finite, value.values() if isinstance(value, dict) else value))
    return value is None or isinstance(value, str) or bool(np.isfinite(value).all())


def _check_accuracy(table, name):
    """Check that the columns of accuracies are numbers, one of each at every wavelength."""
    missing = [key for key in _ACCURACY if key not in table.colnames]
    if missing:
        raise CalibrationFileError(f"{name} has no column {', '.join(missing)}")
    for key in _ACCURACY:
        column = table[key]
        if column.dtype.kind not in "iuf" or column.ndim != 1:
            raise CalibrationFileError(f"{name}: {key} is not a list of numbers")
        # s_res, s_mean and s_cv are shares of the light, in percent
        unit = getattr(column, "unit", None) or u.one
        if key.startswith("s_") and not unit.is_equivalent(u.percent):
            raise CalibrationFileError(f"{name}: {key} is in {unit}, which is not a fraction")
    length = u.Quantity(table["wavelength"])
    if not length.unit.is_equivalent(u.um) or not np.all(length.value > 0):
        raise CalibrationFileError(f"{name}: wavelength = {length} must be positive lengths")


def content_hash(calibration):
    """Return the SHA-256 of all that a calibration file keeps, the ``checksum`` of the file.

    A calibration in memory has one as well if its optics are of classes that files cannot hold.
    """
    return _spelled(calibration)["checksum"]
