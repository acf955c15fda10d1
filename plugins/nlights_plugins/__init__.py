"""The bundled algorithms, offered through the same door as anyone's."""
