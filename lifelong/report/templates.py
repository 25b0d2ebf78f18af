"""Templates of pages: self-contained HTML in one style."""

import jinja2
import numpy as np


def page_template(name: str, package: str = "lifelong.report") -> jinja2.Template:
    """Return a template of a package, with the filter `percent`; an undefined name is an error.

    Args:
        name: File of the template; it may include those of `lifelong.report`.
        package: Package whose folder holds it.
    """
    environment = jinja2.Environment(
        loader=jinja2.ChoiceLoader([jinja2.PackageLoader(p, ".") for p in (package, "lifelong.report")]),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["percent"] = percent
    return environment.get_template(name)


def percent(value: float | None, digits: int = 1) -> str:
    """Format a share as percent with a typographic minus sign; a dash where it is undefined."""
    if value is None or np.isnan(value):
        return "–"
    text = f"{100 * value:.{digits}f}"
    return text.removeprefix("-") if float(text) == 0 else text.replace("-", "−")
