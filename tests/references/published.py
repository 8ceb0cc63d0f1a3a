"""Hand-made result files in the format of the SCB benchmark."""

from pathlib import Path


def result_text(
    plain: str = "[0.01, 0.03, 0.08]", average: str = "[0.04]", flipped: str = "true", time: str = "474"
) -> str:
    """The layout of BenchResult_BlendedMap_cat0_to_cat6.txt, tab for tab, with three samples and two landmarks."""
    return f"""Stats:
\tAverage\t{average}
\tFolder\t[cat0]
\tGuessed\t[0.993164]
\tNumGen\t[6, 6]
\tObjFn\t[0]
\tPerSampleErrors\t{plain}
\tTime\t[{time}]
\tTimeBench\t[0]
Stats1:
\tAverage\t[0.5]
\tGuessed\t[0]
\tNumGen\t[6, 6]
\tObjFn\t[0.7]
\tPerSampleErrors\t[0.5, 0.5, 0.5]
StatsWithFlip:
\tAverage\t[0.015]
\tFlipped\t[{flipped}]
\tGuessed\t[1]
\tNumGen\t[6, 6]
\tObjFn\t[0]
\tPerSampleErrors\t[0.03, 1.24143e-11]
"""


def write(folder: Path, name: str = "BenchResult_BlendedMap_cat0_to_cat6.txt", text: str | None = None) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / name
    path.write_text(result_text() if text is None else text)
    return path
