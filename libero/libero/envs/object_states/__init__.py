"""States of objects, fixtures and regions."""

from libero.libero.envs.object_states.base_object_states import BaseObjectState, ObjectState, SiteObjectState
