"""The commissioning record: drawings, a page for browsers and the same for paper."""
