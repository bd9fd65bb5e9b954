"""Systems from settings: `choices` has the settings of each choice, `assembly` makes a System of them."""
