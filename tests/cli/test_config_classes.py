import pytest

from torchqm.cli.console import UserError
from torchqm.cli.learn import learn


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("{precision: 12}", "precision: '12' given, expected one of 64, 32, 16, .*16-mixed.* or null$"),
        ("{callbacks: [{class_path: torchqm.learn.callbacks.Versoins}]}",
         r"callbacks: there is no torchqm.*Versoins; the nearest is torchqm\.learn\.callbacks\.Versions$"),
        ("{logger: {class_path: torchqm.lern.logger.RunLogger}}",
         r"logger: there is no module torchqm\.lern; the nearest is torchqm\.learn$"),
        ("{callbacks: [{class_path: Versoins}]}",
         r"callbacks: 'Versoins' given, expected the dotted name .* nearest is torchqm\.learn\.callbacks\.Versions$"),
        ("{logger: {class_path: torchqm.learn.logger.RunLogger, init_args: {version: []}}}",
         r"logger\.init_args\.version: '\[\]' given, expected int or str or null$"),
        ("{strategy: 12}", "strategy: '12' given, expected the dotted name of a Strategy or str$"),
        ("{max_epochs: ten}", "max_epochs: 'ten' given, expected int or null$"),
    ],
)  # fmt: skip
def test_what_is_allowed_and_the_class_that_was_meant(tmp_path, text, line):
    path = tmp_path / "c.yaml"
    path.write_text(f"trainer: {text}\n")
    with pytest.raises(UserError, match=rf"^{path}: trainer\.{line}"):
        learn(["--data.root", "synthetic:", "--config", str(path)], run=False)
