"""What settings share: checks of their fields, numbers in a text, and nested settings as one flat dict."""

from __future__ import annotations

from collections.abc import Sequence


def check_at_least(settings, low: float, *names: str) -> None:
    """Raise ``ValueError`` for a field below ``low``."""
    for name in names:
        if not (value := getattr(settings, name)) >= low:  # so that NaN is refused too
            raise ValueError(f"{type(settings).__name__}.{name} must be at least {low}, got {value}")


def check_share(settings, *names: str) -> None:
    """Raise ``ValueError`` for a field that is not within 0 and 1."""
    for name in names:
        if not 0 <= (value := getattr(settings, name)) <= 1:
            raise ValueError(f"{type(settings).__name__}.{name} must be 0 to 1, got {value}")


def check_choice(settings, name: str, choices: Sequence[str]) -> None:
    """Raise ``ValueError`` for a field that is none of the choices."""
    if (value := getattr(settings, name)) not in choices:
        raise ValueError(
            f"{type(settings).__name__}.{name} must be one of {', '.join(choices)}, got {value!r}"
        )


def flatten(settings: dict, prefix: str = "") -> dict:
    """Return nested settings with dotted names, such as ``world_model.updates``."""
    flat = {}
    for name, value in settings.items():
        flat |= flatten(value, f"{prefix}{name}.") if isinstance(value, dict) else {f"{prefix}{name}": value}
    return flat


def parse_numbers(text: str, option: str) -> list[int]:
    """Parse numbers such as ``0,1,2``.

    Raises:
        ValueError: an entry is no whole number.
    """
    try:
        return [int(number) for number in text.split(",")]
    except ValueError as error:
        raise ValueError(f"{option} must be whole numbers such as 0,1,2, got {text!r}") from error
