from .pack import BUILTIN, VARIABLE, BuiltinPack, Choice, Pack, chosen_assets, select_pack

__all__ = ["BUILTIN", "BuiltinPack", "Choice", "Pack", "VARIABLE", "chosen_assets", "select_pack"]
