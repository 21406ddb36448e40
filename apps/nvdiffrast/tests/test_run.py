"""`rts_nvdiffrast run`: scripts for a GPU as they are, and one line where they cannot run."""

import importlib.util
import subprocess
import sys

import pytest
import torch
from rts_nvdiffrast.__main__ import main
from rts_nvdiffrast.redirect import redirected

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
torch.optim.Adam([pos]).zero_grad()
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
FORMS = {
    "in other threads": """
import threading
found = []
def work():
    x = torch.zeros(2, device="cuda").cuda()
    found.append(x.to("cuda:1").pin_memory() + torch.ones(2).to(device="cuda"))
thread = threading.Thread(target=work)
thread.start()
thread.join()
assert found[0].tolist() == [1, 1]
""",
    "in a backward of its own": """
class Double(torch.autograd.Function):
    @staticmethod
    def forward(ctx, x):
        return 2 * x
    @staticmethod
    def backward(ctx, g):
        return g * torch.full((2,), 2.0, dtype=torch.float32, device="cuda") + torch.zeros_like(g, device="cuda").cuda()
x = torch.ones(2, device="cuda", requires_grad=True)
Double.apply(x).sum().backward()
assert x.grad.tolist() == [2, 2]
""",
    "types of tensors": """
x = torch.cuda.FloatTensor([1, 2])
assert x.dtype == torch.float32 and isinstance(x, torch.cuda.FloatTensor)
assert torch.cuda.LongTensor(3).fill_(1).type("torch.cuda.DoubleTensor").dtype == torch.float64
assert x.type(torch.cuda.IntTensor).dtype == torch.int32 and x.type(torch.int64).dtype == torch.int64
assert x.type(dtype="torch.cuda.DoubleTensor").dtype == torch.float64 == x.type(dtype=torch.cuda.DoubleTensor).dtype
assert x.to(dtype=torch.float16).dtype == torch.float16 and torch.ones(2, dtype=torch.int32).dtype == torch.int32
assert x.type() == "torch.FloatTensor" and x.new_zeros(3, device="cuda").tolist() == [0, 0, 0]
""",
    "what a device is": """
assert "CPU" in torch.cuda.get_device_name() and "CPU" in torch.cuda.get_device_name(0)
free, total = torch.cuda.mem_get_info()
assert total >= free > 1 << 20
properties = torch.cuda.get_device_properties(0)
assert properties.name == torch.cuda.get_device_name() and properties.total_memory == total
assert (properties.major, properties.minor) == torch.cuda.get_device_capability() == torch.cuda.get_device_capability(0)
assert properties.major >= 5 and properties.multi_processor_count >= 1
assert torch.cuda.get_device_properties(torch.device("cuda")) == properties
x = torch.zeros(2, device="cuda")
assert "cuda:%d" % x.device.index == "cuda:0" and torch.ones(2, device=x.device).device == x.device
assert torch.device("cuda").type == "cuda" and isinstance(torch.device("cuda", 0), torch.device)
""",
    "functions that take a device": """
import warnings
for window in (torch.bartlett_window, torch.blackman_window, torch.kaiser_window, torch.hann_window):
    assert torch.equal(window(8, device="cuda"), window(8))
assert torch.fft.fftfreq(4, device="cuda:0").shape == (4,) and torch.fft.rfftfreq(4, device="cuda").shape == (3,)
assert torch.signal.windows.gaussian(4, std=1.0, device="cuda").shape == (4,)
assert torch.empty_permuted((2, 3), (1, 0), device="cuda").stride() == (1, 2)
assert torch.ones(2).new_empty_strided((2, 3), (1, 2), device="cuda").stride() == (1, 2)
warnings.simplefilter("ignore")
rows = torch.sparse_csr_tensor(torch.tensor([0, 1, 2]), torch.tensor([1, 0]), torch.ones(2), (2, 2), device="cuda")
assert rows.to_dense().tolist() == [[0, 1], [1, 0]]
""",
    "memory": """
torch.cuda.ipc_collect()
torch.cuda.reset_accumulated_memory_stats()
torch.cuda.reset_max_memory_cached()
torch.cuda.set_per_process_memory_fraction(0.5)
""",
    "streams": """
stream = torch.cuda.Stream()
stream.wait_stream(torch.cuda.current_stream())
stream.wait_stream(torch.cuda.default_stream())
torch.cuda.set_stream(stream)
with torch.cuda.stream(stream):
    torch.cuda.current_stream().synchronize()
""",
    "modules of layers": """
net = torch.nn.Sequential(torch.nn.Linear(2, 2, device="cuda"), torch.nn.ReLU()).cuda().to("cuda", torch.float64)
assert net(torch.ones(1, 2, dtype=torch.float64, device=torch.device("cuda"))).shape == (1, 2)
assert torch.jit.script(lambda x: torch.zeros(2, device="cuda") + x)(1).tolist() == [1, 1]
""",
}
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
    assert done.stdout.strip() == "12 cpu:0 tensor(True)"


@pytest.mark.parametrize("form", FORMS)
def test_a_form_of_cuda(form):
    with redirected():
        exec(FORMS[form], {"torch": torch})  # noqa: S102


@pytest.mark.parametrize("options, answer", [([], "False 0"), (["--pretend-cuda"], "True 1")])
def test_cuda_is_there_if_it_is_pretended(tmp_path, capsys, options, answer):
    script = tmp_path / "script.py"
    script.write_text("import torch\nprint(torch.cuda.is_available(), torch.cuda.device_count())")
    main(["run", *options, str(script)])
    assert capsys.readouterr().out.strip() == answer


def test_names_are_as_before_when_the_script_has_ended():
    before = torch.zeros, torch.Tensor.to, torch.Tensor.device, torch.cuda.is_available, torch.load
    with pytest.raises(ZeroDivisionError), redirected(pretend=True):
        assert torch.zeros is not before[0]
        raise ZeroDivisionError
    assert (torch.zeros, torch.Tensor.to, torch.Tensor.device, torch.cuda.is_available, torch.load) == before
    assert torch.zeros(1).device.index is None and "nvdiffrast" not in sys.modules


def test_a_film_names_the_package_that_it_needs(tmp_path):
    pytest.importorskip("imageio")
    if importlib.util.find_spec("imageio_ffmpeg") is not None:
        pytest.skip("imageio-ffmpeg is installed")
    script = tmp_path / "script.py"
    script.write_text("import imageio, sys\nimageio.get_writer(sys.argv[1], mode='I', fps=30, codec='libx264')")
    with pytest.raises(SystemExit, match="pip install imageio-ffmpeg") as end:
        main(["run", str(script), str(tmp_path / "progress.mp4")])
    assert "\n" not in str(end.value)


@pytest.mark.parametrize("script", [EXTENSION, DOTTED, FROM])
def test_an_extension_for_cuda_is_named_in_one_line(tmp_path, script):
    (tmp_path / "script.py").write_text(script)
    done = run(tmp_path, "run", "script.py")
    assert done.returncode == 1
    asked = "compiling an extension (torch.utils.cpp_extension) cannot run without a GPU; load was asked for"
    assert done.stderr.strip() == f"rts_nvdiffrast: {asked}"


@pytest.mark.parametrize(
    "arguments", [[], ["run"], ["run", "--pretend-cuda"], ["draw", "script.py"], ["run", "missing.py"]]
)
def test_wrong_use_takes_one_line(arguments):
    with pytest.raises(SystemExit) as end:
        main(arguments)
    message = str(end.value)
    assert "\n" not in message
    assert "missing.py" in message or message.startswith("usage: rts_nvdiffrast run")


def test_help_says_how_to(capsys):
    main(["--help"])
    assert capsys.readouterr().out.startswith("usage:")
