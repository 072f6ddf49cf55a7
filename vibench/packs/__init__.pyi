"""The public names of `vibench.packs`: model packs."""

from .checks import read_model_pack as read_model_pack
from .pack import ModelPack as ModelPack
from .reader import pack_digest as pack_digest
