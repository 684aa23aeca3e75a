# FACERENDER_SHADERS_DIR, the include root, and the target facerender::shaders, which has it as its
# include directory.
get_filename_component(FACERENDER_SHADERS_DIR
    "${CMAKE_CURRENT_LIST_DIR}/../../facerender/shaders" ABSOLUTE)
if(NOT TARGET facerender::shaders)
    add_library(facerender::shaders INTERFACE IMPORTED)
    target_include_directories(facerender::shaders INTERFACE "${FACERENDER_SHADERS_DIR}")
endif()
