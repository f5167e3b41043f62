# Licensed under a 3-clause BSD style license - see LICENSE
"""
Samples of a posterior in a calibration file.

A file keeps a part of the samples, and what the whole run says of its
convergence, its quantiles among it.
"""

from astropolcal.exceptions import AstropolcalError, CalibrationFileError

__all__ = ["check_posterior", "node_from_posterior", "posterior_from_node"]

# for those who look into the file
_DERIVED = ("converged", "words", "kept")


def node_from_posterior(posterior):
    """
    Return the node that stores a posterior.

    Parameters
    ----------
    posterior : Posterior
        If it is not thinned yet, it is thinned as
        `~astropolcal.calibration.Posterior.thinned` does by default.

    Returns
    -------
    dict
        As the schema ``calibration-1.0.0`` describes it.

    Examples
    --------
    >>> import numpy as np
    >>> from astropolcal.calibration import Posterior
    >>> from astropolcal.converters.posterior import node_from_posterior
    >>> chain = np.random.default_rng(1).normal(size=(4000, 8, 1))
    >>> node = node_from_posterior(Posterior(["hwp.theta"], ["deg"], chain, chain[..., 0]))
    >>> node["chain"].size <= 4000, node["converged"]
    (True, True)
    """
    from astropolcal.converters.nodes import plain, unit_text

    kept = posterior if posterior.is_thinned else posterior.thinned()
    parts = kept.to_dict()
    # what was thinned has no burn-in any more
    del parts["burn_in"]
    return {
        **plain(parts, "posterior"),
        "units": [unit_text(unit) for unit in kept.units],
        "converged": kept.converged,
        "words": kept.words(),
        "kept": kept.kept_words(),
    }


def posterior_from_node(node):
    """
    Return the posterior that a node stores.

    Parameters
    ----------
    node : dict
        Its node, which obeys the schema.

    Returns
    -------
    Posterior
        Thinned.

    Raises
    ------
    CalibrationFileError
        If its parts do not belong together.

    Examples
    --------
    >>> import numpy as np
    >>> from astropolcal.calibration import Posterior
    >>> from astropolcal.converters.posterior import node_from_posterior, posterior_from_node
    >>> chain = np.random.default_rng(1).normal(size=(100, 8, 1))
    >>> posterior = Posterior(["hwp.theta"], ["deg"], chain, chain[..., 0]).thinned()
    >>> posterior_from_node(node_from_posterior(posterior)) == posterior
    True
    """
    import numpy as np

    from astropolcal.calibration import Posterior
    from astropolcal.converters.nodes import plain

    parts = {key: value for key, value in node.items() if key not in _DERIVED}
    # copies of our own: what ASDF gives may be tied to the file
    for key in ("chain", "log_prob", "acceptance", "fitted"):
        parts[key] = None if parts[key] is None else np.array(parts[key])
    found = {
        key: np.array(value) if hasattr(value, "__array__") else value
        for key, value in parts["convergence"].items()
    }
    # that of what did not move is not a number
    if np.isinf(found["times"]).any():
        raise CalibrationFileError("posterior: times must be finite")
    parts |= {"settings": plain(parts["settings"]), "convergence": found, "burn_in": None}
    try:
        return Posterior.from_dict(parts)
    except AstropolcalError as error:
        raise CalibrationFileError(f"posterior: {error}") from None


def check_posterior(posterior, covariance):
    """
    Check a posterior against the free parameters of its calibration.

    Parameters
    ----------
    posterior : Posterior or None
        The posterior.
    covariance : Covariance
        Of all free parameters.

    Raises
    ------
    CalibrationFileError
        If it has samples of something else, in other units, or no finite ones.

    Examples
    --------
    >>> import numpy as np
    >>> from astropolcal.calibration import Covariance, Posterior
    >>> from astropolcal.converters.posterior import check_posterior
    >>> chain = np.random.default_rng(1).normal(size=(100, 8, 1))
    >>> posterior = Posterior(["hwp.theta"], ["deg"], chain, chain[..., 0])
    >>> check_posterior(posterior, Covariance(["hwp.w_sio2"], ["mm"], [[1.0]]))
    Traceback (most recent call last):
    ...
    astropolcal.exceptions.CalibrationFileError: posterior of 'hwp.theta', which is ...
    """
    import numpy as np

    if posterior is None:
        return
    units = dict(zip(covariance.names, covariance.units, strict=True))
    if len(set(posterior.names)) < len(posterior.names):
        raise CalibrationFileError("posterior: a parameter is named twice")
    for name, unit in zip(posterior.names, posterior.units, strict=True):
        if name not in units:
            raise CalibrationFileError(f"posterior of {name!r}, which is no free parameter")
        if unit != units[name]:
            raise CalibrationFileError(
                f"posterior of {name} is in {unit}, allowed is {units[name]}"
            )
    for what, values in (("samples", posterior.chain), ("log_prob", posterior.log_prob)):
        if not values.size or not np.isfinite(values).all():
            raise CalibrationFileError(f"posterior: {what} must be finite, and some")
