"""Floor 6: layers that drop into a learned pipeline; each holds options and calls one function of a lower floor."""

__all__: list[str] = []
