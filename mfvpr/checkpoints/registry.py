"""Registry of published weights: names, sources, sizes, hashes and licenses. It contains no weights."""

import difflib
import re
import shlex
from dataclasses import dataclass, replace

from mfvpr.utils.errors import InputError


@dataclass(frozen=True)
class Entry:
    """One published file."""

    name: str
    network: str
    file: str  # the official file name
    source: str  # its authors' address
    size: int | None  # bytes; None where not published
    sha256: str | None  # None where not published
    code_license: str
    weights_license: str
    like: str | None = None  # weights of one's own: the published entry of the same network

    @property
    def license(self) -> str:
        """Licenses of the code and of the weights, as their authors state them."""
        return f"code {self.code_license}, weights {self.weights_license}"


_LICENSES = {  # network -> of the code and of the weights
    "d2net": ("BSD-3-Clause-Clear", "none stated"),
    "mixvpr": ("none stated", "none stated"),
    "aliked": ("BSD-3-Clause", "BSD-3-Clause"),
    "lightglue": ("Apache-2.0", "Apache-2.0"),
    "ssm": ("MIT (SSM-VPR)", "CC BY (Places365)"),
    "netvlad": ("MIT", "MIT"),
    "patch_netvlad": ("MIT", "MIT"),
    "gem": ("MIT", "MIT"),
    "dinov2": ("Apache-2.0", "Apache-2.0"),
    "selavpr": ("MIT, Apache-2.0", "none stated"),
}
_PLACES365 = (
    "https://imr.ciirc.cvut.cz/uploads/Datasets/checkpoints.zip, or the Caffe model it was made from, "
    "http://places2.csail.mit.edu/models_places365/vgg16_places365.caffemodel"
)
_D2NET, _HLOC = "https://dusmanu.com/files/d2-net", "https://cvg-data.inf.ethz.ch/hloc/netvlad"
_NANNE = "vgg16_netvlad_checkpoint.zip at https://drive.google.com/open?id=17luTjZFCX639guSVy00OUtzfTQo4AMF2"
_COSPLACE = "https://github.com/gmberton/CosPlace/releases/download/v1.0"
_DINOV2 = "https://dl.fbaipublicfiles.com/dinov2"


def _entry(
    network: str,
    name: str,
    source: str,
    *,
    file: str = "",
    size: int | None = None,
    sha256: str | None = None,
    license: str | None = None,
) -> Entry:
    """Entry with the network's licenses, or with `license` for both; the source ends with the file by default."""
    licenses = (license, license) if license else _LICENSES[network]
    return Entry(name, network, file or source.rpartition("/")[2], source, size, sha256, *licenses)


def _mixvpr(channels: int, rows: int, drive_id: str) -> Entry:
    width = channels * rows
    file = f"resnet50_MixVPR_{width}_channels({channels})_rows({rows}).ckpt"
    return _entry("mixvpr", f"mixvpr_{width}", _drive(drive_id), file=file)


def _aliked(variant: str, size: int, sha256: str) -> Entry:
    source = f"https://github.com/Shiaoming/ALIKED/raw/main/models/aliked-{variant}.pth"
    return _entry("aliked", f"aliked-{variant}", source, size=size, sha256=sha256)


def _patchnetvlad(training: str, outputs: int, size: int | None, sha256: str) -> Entry:
    source = f"https://huggingface.co/TobiasRobotics/Patch-NetVLAD/resolve/main/{training}_WPCA{outputs}.pth.tar"
    return _entry("patch_netvlad", f"patchnetvlad_{training}_{outputs}", source, size=size, sha256=sha256)


def _drive(file_id: str) -> str:
    return f"https://drive.google.com/file/d/{file_id}/view"


# fmt: off
_ENTRIES = (
    *(_entry("d2net", name, f"{_D2NET}/{name}.pth") for name in ("d2_tf", "d2_ots", "d2_tf_no_phototourism")),
    _mixvpr(1024, 4, "1vuz3PvnR7vxnDDLQrdHJaOA04SQrtk5L"),
    _mixvpr(256, 2, "1khiTUNzZhfV2UUupZoIsPIbsMRBYVDqj"),
    _mixvpr(64, 2, "1DQnefjk1hVICOEYPwE4-CZAZOvi1NSJz"),
    _aliked("t16", 794_859, "56782336919db220144a884e710e2b6af13b3b8f8da15b915a239078ab471085"),
    _aliked("n16", 2_738_091, "5be8704840ed662d9d8c561bf7279c222092674e7eb05fd0feab94899e9d82f2"),
    _aliked("n16rot", 2_738_325, "ddf3abbf38e86f6a74540d214e1a9712c54b2d8551abc864542199f2347d7332"),
    _aliked("n32", 3_946_667, "055283fd1624d3ab46a05c3b617b1a79a3f28d1f551737eef2d653e8c8232890"),
    _entry("lightglue", "aliked_lightglue",
           "https://github.com/cvg/LightGlue/releases/download/v0.1_arxiv/aliked_lightglue.pth",
           size=47_632_827, sha256="d975e965b105311a6143194852297dff4f02aea5cc2e10cecfed966ca0e22503"),
    _entry("ssm", "vgg16_places365", _PLACES365, file="vgg16_places365.npy"),
    _entry("netvlad", "netvlad_pitts30k", f"{_HLOC}/Pitts30K_struct.mat"),
    _entry("netvlad", "netvlad_tokyotm", f"{_HLOC}/TokyoTM_struct.mat"),
    _entry("netvlad", "netvlad_pytorch", _NANNE, file="checkpoint.pth.tar", license="none stated"),
    _entry("gem", "cosplace_vgg16_512", f"{_COSPLACE}/VGG16_512_cosplace.pth"),
    _entry("gem", "cosplace_resnet50_512", f"{_COSPLACE}/ResNet50_512_cosplace.pth"),
    _entry("gem", "cosplace_resnet50_2048", f"{_COSPLACE}/ResNet50_2048_cosplace.pth"),
    _patchnetvlad("mapillary", 128, 67_319_611, "5b6de8a5537061bbe7a477b62bb687b042d92d472e5231e2072026ecc59ec4b1"),
    _patchnetvlad("mapillary", 512, 92_488_008, "acbe2597c1c23c95482883c05969006a74bf7e68c4151dbb4ab5d67b69e8e346"),
    _patchnetvlad("mapillary", 4096, 327_398_210, "4b22ad1619bb7f085a5229d35f0f865740f2cdad2bced2ddbc7b28791c5b1542"),
    _patchnetvlad("pitts", 128, 92_681_537, "74bb0e0113c074ed9b07651a5f01bd424171d8e3b91d7024d2ccb0b0392164f3"),
    _patchnetvlad("pitts", 512, None, "309611d927c759e897e1eb27977994236b5618d9d3cd7202035cea1b56c08c1c"),
    _patchnetvlad("pitts", 4096, 1_132_901_186, "2c3cf17de91974156cb6aee40a6f7a229825095273d7de87c0792084ae1bf4aa"),
    _patchnetvlad("landmarks", 4096, None, "659a837b11883ed8a8ea5e1d1a46eb2871ea26514fbfc2ad7d9d4e1334380a34"),
    *(_entry("dinov2", f"dinov2_{name}", f"{_DINOV2}/dinov2_{name}/dinov2_{name}_pretrain.pth")
      for name in ("vits14", "vitb14", "vitl14")),
    _entry("selavpr", "selavpr_pitts30k", _drive("1LKTZZRHfMH3dY3UPagCt2TIlMN5LguGO"), file="SelaVPR_pitts30k.pth"),
    _entry("selavpr", "selavpr_msls", _drive("1vy05l0JTEgr6n8iSoz_P_yjWfEzFPAkV"), file="SelaVPR_msls.pth"),
    _entry("selavpr", "selavpr_msls_registers", _drive("16Qkr6MGe3k0kYtFfw3YLQXZFn4c9YvJk"),
           file="SelaVPR_reg4_msls.pth"),
)
# fmt: on

REGISTRY: dict[str, Entry] = {entry.name: entry for entry in _ENTRIES}


OWN = "own/"  # names of weights of one's own begin with it, also in settings and run folders


def own_entry(name: str, like: str) -> Entry:
    """Entry of weights of one's own, for the network of the published weights `like`."""
    if not re.fullmatch(rf"{OWN}[\w-]+", name):
        raise InputError(f"{name.removeprefix(OWN)}: expected a name of letters, digits, - and _")
    none = {"source": "-", "size": None, "sha256": None, "code_license": "-", "weights_license": "-"}
    return replace(entry_of(like), name=name, file="FILE", like=like, **none)


def how_to_install(entry: Entry) -> str:
    """The first command that installs the weights of an entry."""
    if entry.like is not None:
        return f"mfvpr weights add FILE --own {entry.name.removeprefix(OWN)} --as {entry.like}"
    command = f"add {shlex.quote(entry.file)}" if entry.sha256 is None else f"download {entry.name}"
    return f"mfvpr weights {command}"


def entry_of(name: str) -> Entry:
    """The entry called `name`.

    Raises:
        InputError: the name is unknown; the message suggests the nearest name, or lists all.
    """
    if name in REGISTRY:
        return REGISTRY[name]
    nearest = difflib.get_close_matches(name, REGISTRY, n=1)
    hint = f"the nearest is {nearest[0]}" if nearest else f"expected one of {', '.join(REGISTRY)}"
    raise InputError(f"{name}: no weights of this name; {hint}")
