"""Two policies episode by episode: exact and sequential tests, intervals, and how many episodes a difference needs."""
