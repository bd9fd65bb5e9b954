"""Systems from settings: `assembly` has the settings of each choice, and makes a System of them."""
