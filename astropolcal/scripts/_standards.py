# Licensed under a 3-clause BSD style license - see LICENSE
"""
List polarimetric standard stars and when they are observable.

With a site and a night, those that rise above the limit, the best for the
diattenuation of the telescope first. With a name, all that is known of a star.

For example::

  astropolcal standards --kind polarized --band H --magnitude 4,8
  astropolcal standards --site subaru --night 2025-11-03
  astropolcal standards HD30675
"""

import math

import astropy.units as u
from astropy.coordinates import EarthLocation

from astropolcal import standards
from astropolcal.exceptions import ParameterError
from astropolcal.scripts import _common as common
from astropolcal.standards.priors import assumed_polarization
from astropolcal.standards.visibility import SITES, location
from astropolcal.words import counted, did_you_mean, with_error

OPTIONS = """
name NAME ?  a star, such as 'HD 293396'
--kind {polarized,unpolarized} not:name  only stars of this kind
--band BAND not:name  magnitude and polarization in this band, such as H; the magnitude in V where
    the catalogue has none in it
--magnitude LO,HI pair not:name  brightest and faintest magnitude, in --band, or in V where the
    catalogue has none in it
--near RA,DEC not:name  degrees, or 05:26:06,+16:42:00
--radius DEG float needs:near  goes with --near (default: 15)
--site SITE needs:night  subaru, keck, paranal, gemini_south or LON,LAT,HEIGHT
--night YYYY-MM-DD needs:site  date of the evening at the site
--min-altitude DEG float needs:night  goes with --night: lowest altitude (default: 30)
--limit N int not:name  how many to list, the best first (default: 20 of a night, else all)
@ json online quiet
"""
TYPES = {"pair": common.text_type("2 numbers with a comma between them", common.numbers, 2)}


def run(arguments):
    """Print the stars."""
    if arguments.limit is not None and arguments.limit < 1:
        raise ParameterError(f"--limit {arguments.limit}: allowed are whole numbers from 1 up")
    if arguments.min_altitude is None:
        arguments.min_altitude = 30.0
    lines, content = (_one if arguments.name else _many)(arguments)
    common.give(arguments, lines, content)


# ---- one star -----------------------------------------------------------------------


def _one(arguments):
    star = standards.get(arguments.name)
    content = _facts(star)
    lines = _describe(star, content["known"])
    if arguments.night is None:
        return lines, content
    site, limit = _site(arguments.site), arguments.min_altitude * u.deg
    seen = standards.observability(star.name, site, arguments.night, min_altitude=limit)
    (low, high), (first, last) = seen.altitude.value, seen.parallactic.value
    content |= {"site": arguments.site, "night": seen.night, "hours": seen.hours.value}
    content |= {"transit": seen.transit.iso, "altitude_deg": [low, high]}
    # of 32 frames, as in the table of a night
    error = seen.information(32).diattenuation
    content |= {"parallactic_deg": [first, last], "m3_error": error}
    # hours and minutes of an ISO time
    start, end = (seen.table["time"][seen.table["observable"]][i].iso[11:16] for i in (0, -1))
    lines += [
        "",
        f"Night of {seen.night}, {arguments.site}, above {arguments.min_altitude:g} deg",
        f"  observable   {start} to {end} UTC, {seen.hours.value:.1f} h",
        f"  highest      {seen.transit.iso[:16]} UTC",
        # the format z: what rounds to zero has no sign
        f"  altitude     {low:z.1f} to {high:z.1f} deg",
        f"  parallactic  {first:z.1f} to {last:z.1f} deg",
        f"  M3 error     {with_error(error, '.3f')} of one frame's error (32 frames)",
    ]
    return lines, content


def _describe(star, known):
    """Return the lines that say what is known of a star, and what a calibration assumes of it."""
    place = star.coord.to_string("hmsdms", sep=":", precision=1)
    bright = "  ".join(f"{b} {m.value:g}" for b, m in star.magnitudes.items())
    facts = {"position": f"{place} (ICRS, +-{star.position_error.value:g} arcsec)"}
    facts |= {"also": ", ".join(star.aliases), "magnitudes": bright or "not known"}
    facts |= {"type": star.spectral_type, "note": star.note}
    facts = [f"  {name:<11} {words}" for name, words in facts.items() if words]
    lines = [f"{star.name}: {star.kind} standard star"]
    lines += [common.wrapped(fact, indent=14) for fact in facts]
    if star.law is not None:
        lines += ["", f"  Serkowski law ({star.law_reference})"]
        units = {"p_max": " %", "lambda_max": " um", "K": "", "theta": " deg"}
        for name, unit in units.items():
            value, error = getattr(star.law, name).value, star.law_errors.get(name)
            value = 100 * value if name == "p_max" else value
            spread = "" if error is None else f" +- {getattr(error, 'value', error):.3g}"
            lines.append(f"    {name:<10}  {value:.4g}{spread}{unit}")
    if known is not None:
        lines += ["", "  In a calibration"]
        for row in known["stokes"]:
            degree = f"{with_error(row['p_percent'], '.2f', row['p_err_percent'])} %"
            what = f"q, u {degree}"
            if row["theta_deg"] is not None:
                angle = with_error(row["theta_deg"], ".1f", row["theta_err_deg"])
                what = f"p {degree}, theta {angle} deg"
            lines.append(f"    {row['wavelength_um']:.2f} um   {what}")
        lines += [common.wrapped(f"    - {words}", indent=6) for words in known["words"]]
    if len(star.polarization):
        lines += ["", "  band      um     p (%)         theta (deg)   source"]
    for row in star.polarization:
        mark = " " if row["checked"] else "*"
        degree = with_error(row["p"].value, ".3f", row["p_err"].value)
        angle = with_error(row["theta"].value, ".1f", row["theta_err"].value)
        text = f"{mark} {row['band']:<8}  {row['wavelength'].value:.2f}   {degree:<13} {angle:<13}"
        lines.append(f"{text} {row['reference']}")
    if not star.checked:
        lines.append("  * partly from memory: compare with the source before use")
    return lines


# ---- many stars ---------------------------------------------------------------------


def _many(arguments):
    site = None if arguments.site is None else _site(arguments.site)
    near = {}
    if arguments.near:
        radius = 15.0 if arguments.radius is None else arguments.radius
        near = {"center": common.sky_position(arguments.near, "--near"), "radius": radius * u.deg}
    given = {key: getattr(arguments, key) for key in ("kind", "band", "magnitude", "night")}
    lowest = arguments.min_altitude * u.deg
    found = standards.search(**near, **given, site=site, min_altitude=lowest)
    if not len(found):
        limit = f" above {arguments.min_altitude:g} deg" if arguments.night else ""
        raise ParameterError(f"no standard star{limit} fits what was asked")
    # a machine gets all unless it asks for fewer
    rows = [_row(row) for row in found[: arguments.limit]]
    content = {"site": arguments.site, "night": arguments.night, "stars": rows}
    # of a night, whose list is ordered by how good a star is, so that its end is of no use
    shown = found[: arguments.limit or (20 if arguments.night else None)]
    lines = _night_table(shown) if arguments.night else _table(shown, arguments.band)
    lines += _band_lines(shown, arguments)
    if more := len(found) - len(shown):
        lines += ["", f"{counted(more, 'more star')}; --limit {len(found)} lists all"]
    return lines, content


def _band_lines(shown, arguments):
    """Return the note on what is of another band than was asked for."""
    band, lines = arguments.band, [""]
    if band is None:
        return []
    others = shown[[math.isfinite(value) for value in shown["magnitude"].value]]
    others = sum(str(other) != band for other in others["magnitude_band"])
    if others:
        selects = ", by which --magnitude selects them" if arguments.magnitude else ""
        lines.append(f"{others} of {len(shown)} have no magnitude in {band}: V instead{selects}.")
    if not arguments.night and not all(_has_degree(row, band) for row in shown):
        lines.append(f"* no polarization in {band}: p is of the band nearest to V")
    return lines if len(lines) > 1 else []


def _has_degree(row, band):
    """Return whether the degree of polarization of a star is known in a band, or none is asked."""
    if band is None:
        return True
    star = standards.get(str(row["name"]))
    return star.law is not None or band in star.polarization["band"]


def _table(found, band=None):
    near = "separation" in found.colnames
    degree = f"p (%) in {band}" if band else "p (%)"
    lines = ["name            kind         RA (ICRS)  dec     mag     "]
    lines[0] += f"{degree:<17}deg" if near else degree
    for row in found:
        # of right ascension
        hours = row["ra"].value / 15
        clock = f"{int(hours):02d} {60 * (hours % 1):04.1f}"
        away = f"  {row['separation'].value:5.1f}" if near else ""
        degree = f"{with_error(row['p'].value, '.3f', row['p_err'].value):<15}"
        mark = " " if _has_degree(row, band) else "*"
        lines.append(
            f"{row['name']:<15} {row['kind']:<11}  {clock}  {row['dec'].value:+z6.1f}   "
            f"{_magnitude(row):<7}{mark}{degree}{away}"
        )
    return [line.rstrip() for line in lines]


def _night_table(found):
    lines = ["name            kind         mag     altitude  parallactic hours     M3   score"]
    for row in found:
        angles = [f"{what}_{end}" for what in ("altitude", "parallactic") for end in ("min", "max")]
        low, high, first, last = (row[name].value for name in angles)
        lines.append(
            f"{row['name']:<15} {row['kind']:<11}  {_magnitude(row):<7} {low:z2.0f} to "
            f"{high:z2.0f}  {first:z4.0f} to {last:z4.0f}  {row['hours'].value:4.1f} "
            f"{with_error(row['m3_error'], '6.3f'):>6}  {with_error(row['m3_score'], '6.3f'):>6}"
        )
    return [
        *lines,
        "",
        "Altitude and parallactic angle in deg. M3: error of the diattenuation of the",
        "telescope from 32 frames, in errors of one frame. score: M3 times the photon",
        "noise against that of magnitude 10; the smaller the better.",
    ]


def _magnitude(row):
    value = row["magnitude"].value
    return f"{value:4.1f} {row['magnitude_band']}" if math.isfinite(value) else "   -"


# ---- machines -----------------------------------------------------------------------


def _facts(star):
    law = star.law
    if law is not None:
        law = {
            "p_max_percent": 100 * law.p_max.value,
            "lambda_max_um": law.lambda_max.value,
            "K": law.K.value,
            "theta_deg": law.theta.value,
            "reference": star.law_reference,
            "doi": star.law_doi or None,
        }
    return {
        "name": star.name,
        "kind": star.kind,
        "ra_deg": star.coord.ra.deg,
        "dec_deg": star.coord.dec.deg,
        "magnitudes": {band: m.value for band, m in star.magnitudes.items()},
        "law": law,
        # R, J, H and K, for what a calibration assumes of a star
        "known": assumed_polarization(star, [0.65, 1.25, 1.65, 2.2] * u.um),
        "measurements": [_row(row) for row in star.polarization],
        "checked": star.checked,
    }


_UNITS = {"deg": "deg", "%": "percent", "um": "um", "mag": "", "h": ""}


def _row(row):
    """Return a row of a table for JSON: unit in the name."""
    units = {name: _UNITS.get(str(getattr(row[name], "unit", "")), "") for name in row.colnames}
    return {
        f"{name}_{unit}" if unit else name: getattr(row[name], "value", row[name])
        for name, unit in units.items()
    }


# ---- what the options mean ----------------------------------------------------------


def _site(text):
    """Return the place, by name or as LON,LAT,HEIGHT."""
    try:
        if "," not in text:
            return location(text)
        lon, lat, height = common.numbers(text, 3)
        return EarthLocation.from_geodetic(lon * u.deg, lat * u.deg, height * u.m)
    except ValueError as error:
        reason = error if "," in text else f"not known{did_you_mean(text, SITES)}"
        raise ParameterError(
            f"--site {text}: {reason}; allowed are {', '.join(SITES)}, or LON,LAT,HEIGHT in deg, "
            "deg and m"
        ) from None
