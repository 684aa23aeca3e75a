# Defines the include directory FACERENDER_SHADERS_DIR, and the target facerender::shaders that uses
# it.
get_filename_component(FACERENDER_SHADERS_DIR
    "${CMAKE_CURRENT_LIST_DIR}/../../facerender/shaders" ABSOLUTE)
if(NOT TARGET facerender::shaders)
    add_library(facerender::shaders INTERFACE IMPORTED)
    target_include_directories(facerender::shaders INTERFACE "${FACERENDER_SHADERS_DIR}")
endif()
