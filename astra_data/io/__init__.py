"""Import from and export to other formats; sharing of datasets."""
