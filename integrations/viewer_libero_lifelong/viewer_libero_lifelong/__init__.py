"""A scene of libero-lifelong in the browser, drawn by mjviser: `libero view`."""
