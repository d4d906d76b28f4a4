"""The one exception a user of omtwarp has to know."""


class OmtwarpError(ValueError):
    """Input that cannot be used, or a request that cannot be met, in one clear line.

    The text names the defect, how many there are, where the first one is and what mends it; the command line prints
    exactly this text and exits with a status other than 0.

    Example:
        >>> import omtwarp
        >>> try:
        ...     omtwarp.map_to_sphere(omtwarp.shapes.icosphere(2), device="gpu")
        ... except omtwarp.OmtwarpError as error:
        ...     print(error)
        unknown device 'gpu': use auto, cpu, cuda or cuda:N
    """
