"""A study table."""

from libero.libero.envs.arenas.base_arena import WorkspaceArena


class StudyTableArena(WorkspaceArena):
    """A study table with its room."""

    category = "study_table"
