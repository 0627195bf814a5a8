"""A checkpoint from a stranger is data: whatever it names, nothing of it is executed, resolved or written to."""

import pytest
from strangers import checkpoint

from mosa.errors import MosaError
from mosa.twin import Twin


def set_adapter(value):
    def change(stored):
        stored["mosa"]["config"]["cfg"]["adapter"] = value

    return change


def test_the_checkpoint_of_these_tests_is_a_good_one(tmp_path):
    """The negative control: without it every refusal below could have another reason."""
    twin = Twin.load(checkpoint(tmp_path / "good.ckpt"))
    assert type(twin.body.adapter).__name__ and len(twin.simulate(frames=2).x) == 2


def test_the_adapter_of_an_older_checkpoint_is_still_known(tmp_path):
    older = {"_target_": "mosa.modules.direct.DirectAdapter", "hidden": 8}
    stored = checkpoint(tmp_path / "a.ckpt", "adapter=direct", "adapter.hidden=8", change=set_adapter(older))
    assert type(Twin.load(stored).body.adapter).__name__ == "DirectAdapter"


@pytest.mark.parametrize("target", ["subprocess.Popen", "subprocess.run", "os.system", "builtins.exec",
                                    "mosa.twin.Twin.load", "mosa.modules.body.Body", "strangers.checkpoint"])
def test_what_a_checkpoint_names_is_not_called(tmp_path, target):
    touched = tmp_path / "touched"
    malicious = {"_target_": target, "args": ["touch", str(touched)], "command": f"touch {touched}"}
    with pytest.raises(MosaError, match=r"adapter\._target_: expected a known adapter"):
        Twin.load(checkpoint(tmp_path / "bad.ckpt", change=set_adapter(malicious)))
    assert not touched.exists()
