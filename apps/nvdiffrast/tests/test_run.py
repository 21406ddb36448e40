"""`python -m rts_nvdiffrast run`: scripts for a GPU as they are, and one line where they cannot run."""

import subprocess
import sys

import pytest
from rts_nvdiffrast.__main__ import main

SCRIPT = """
import argparse
import pathlib
import sys
import torch
import nvdiffrast.torch as dr
from nvdiffrast.torch import rasterize
import beside

parser = argparse.ArgumentParser()
parser.add_argument("--size", type=int)
size = parser.parse_args().size
device = torch.device("cuda")
torch.cuda.set_device(0)
context = dr.RasterizeCudaContext(device=device)
pos = torch.tensor([[[-1.0, -1, 0, 1], [1, -1, 0, 1], [-1, 1, 0, 1]]], device="cuda:0", requires_grad=True)
tri = torch.arange(3, dtype=torch.int32).reshape(1, 3).cuda()
colors = torch.ones([3, 1]).to("cuda", non_blocking=True).to(0).pin_memory().to(device=device)
net = torch.nn.Linear(1, 1).cuda().to(device)
start, end = torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True)
torch.save(tri, "tri.pt")
with torch.cuda.device(0):
    assert torch.equal(torch.load("tri.pt", map_location="cuda"), tri)
assert torch.zeros(2, device=torch.cuda.current_device()).device.type == "cpu"
generator: torch.Generator | None = torch.Generator(device="cuda").manual_seed(1)
assert torch.rand(2, generator=generator).shape == (2,) and isinstance(generator, torch.Generator)
start.record()
rast, _ = rasterize(context, pos, tri, resolution=[size, size])
image = net(dr.interpolate(colors[None], rast, tri)[0]) + torch.zeros(1, device=device, pin_memory=False)
dr.antialias(image, rast, pos, tri).mean().backward()
end.record()
torch.cuda.synchronize()
assert start.elapsed_time(end) > 0
assert pathlib.Path(sys.argv[0]).name == "script.py" and beside.VALUE == 3 and __name__ == "__main__"
print(image.shape[1], pos.grad.device, pos.grad.abs().max() > 0)
"""
EXTENSION = "import torch.utils.cpp_extension as e\ne.load(name='a', sources=['a.cu'])\n"
DOTTED = "import torch.utils.cpp_extension\ntorch.utils.cpp_extension.load(name='a', sources=['a.cu'])\n"
FROM = "from torch.utils.cpp_extension import load\nload(name='a', sources=['a.cu'])\n"


def run(folder, *arguments):
    command = [sys.executable, "-W", "ignore", "-m", "rts_nvdiffrast", *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=300, cwd=folder)


def test_a_script_runs_as_it_is(tmp_path):
    (tmp_path / "deep").mkdir()
    (tmp_path / "deep/script.py").write_text(SCRIPT)
    (tmp_path / "deep/beside.py").write_text("VALUE = 3\n")
    done = run(tmp_path, "run", "deep/script.py", "--size", "12")
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "12 cpu tensor(True)"


@pytest.mark.parametrize("script", [EXTENSION, DOTTED, FROM])
def test_an_extension_for_cuda_is_named_in_one_line(tmp_path, script):
    (tmp_path / "script.py").write_text(script)
    done = run(tmp_path, "run", "script.py")
    assert done.returncode == 1
    asked = "compiling an extension (torch.utils.cpp_extension) cannot run without a GPU; load was asked for"
    assert done.stderr.strip() == f"rts_nvdiffrast: {asked}"


@pytest.mark.parametrize("arguments", [[], ["run"], ["draw", "script.py"], ["run", "missing.py"]])
def test_wrong_use_takes_one_line(arguments):
    with pytest.raises(SystemExit) as end:
        main(arguments)
    message = str(end.value)
    assert "\n" not in message
    assert "missing.py" in message or message.startswith("usage: python -m rts_nvdiffrast run")


def test_help_says_how_to(capsys):
    main(["--help"])
    assert capsys.readouterr().out.startswith("usage:")
