"""`companion keys`: the certificates of a site, and its router's configuration with the rules of access."""
