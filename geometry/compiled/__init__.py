"""The decorator of compiled functions, its cache on disk (geometry's only file), and small linear algebra."""
