from .add import add_object, register_object_file

__all__ = ["add_object", "register_object_file"]
