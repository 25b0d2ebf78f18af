from .encoder import LanguageEncoder, embed

__all__ = ["LanguageEncoder", "embed"]
