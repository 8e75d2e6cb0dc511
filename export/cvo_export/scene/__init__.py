"""A virtual room and a camera in it.

renderer    textured rectangles -> image, exact for any pose; knows nothing of the room
paint       the room's textures
room        its walls and furniture, as faces for the renderer
sensor      what a real camera adds to a rendering: motion blur, light and noise
"""
