"""From views of an object to a signed distance field, and from that to a surface."""
