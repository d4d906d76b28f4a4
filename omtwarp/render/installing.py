"""Commands that install OpenGL and pyrender, for messages about what is missing."""

INSTALL_GL = "apt-get install --no-install-recommends libegl1 libgl1"
INSTALL_PYRENDER = "pip install 'omtwarp[preview]'"
