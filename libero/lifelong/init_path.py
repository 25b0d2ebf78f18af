"""Nothing: the original adds its folder to the path of imports here, which an installed package does not need."""
