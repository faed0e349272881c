"""Build files beside the C of a policy: CMake, and pkg-config through it."""

from __future__ import annotations

from collections.abc import Mapping


def build_files(prefix: str, version: str) -> Mapping[str, str]:
    """Return the files by name."""
    major = version if "." in version else f"{version}.0.0"
    files = {"CMakeLists.txt": CMAKE, f"{prefix}.pc.in": PKG_CONFIG}
    return {name: text.replace("@NAME@", prefix).replace("@VERSION@", major) for name, text in files.items()}


CMAKE = """\
cmake_minimum_required(VERSION 3.13)
project(@NAME@ VERSION @VERSION@ LANGUAGES C)
if(NOT CMAKE_BUILD_TYPE)
  set(CMAKE_BUILD_TYPE Release) # -O3
endif()
include(CTest)
include(GNUInstallDirs)

add_library(@NAME@ @NAME@.c)
set_target_properties(@NAME@ PROPERTIES C_STANDARD 99 C_EXTENSIONS OFF POSITION_INDEPENDENT_CODE ON)
target_include_directories(@NAME@ PUBLIC
  $<BUILD_INTERFACE:${CMAKE_CURRENT_SOURCE_DIR}> $<INSTALL_INTERFACE:${CMAKE_INSTALL_INCLUDEDIR}>)
if(EXISTS ${CMAKE_CURRENT_SOURCE_DIR}/@NAME@_weights.bin)
  set_source_files_properties(@NAME@.c PROPERTIES OBJECT_DEPENDS ${CMAKE_CURRENT_SOURCE_DIR}/@NAME@_weights.bin)
endif()
if(UNIX)
  target_link_libraries(@NAME@ PUBLIC m)
endif()
add_library(@NAME@::@NAME@ ALIAS @NAME@)

if(BUILD_TESTING) # the golden vectors, on the machine that it is built for
  add_executable(@NAME@_test @NAME@_test.c)
  set_target_properties(@NAME@_test PROPERTIES C_STANDARD 99 C_EXTENSIONS OFF)
  target_link_libraries(@NAME@_test @NAME@)
  add_test(NAME @NAME@_golden_vectors COMMAND @NAME@_test)
endif()

configure_file(@NAME@.pc.in @NAME@.pc @ONLY)
install(TARGETS @NAME@ EXPORT @NAME@-config)
install(EXPORT @NAME@-config NAMESPACE @NAME@:: DESTINATION ${CMAKE_INSTALL_LIBDIR}/cmake/@NAME@)
install(FILES @NAME@.h DESTINATION ${CMAKE_INSTALL_INCLUDEDIR})
install(FILES ${CMAKE_CURRENT_BINARY_DIR}/@NAME@.pc DESTINATION ${CMAKE_INSTALL_LIBDIR}/pkgconfig)
"""
PKG_CONFIG = """\
prefix=@CMAKE_INSTALL_PREFIX@
libdir=${prefix}/@CMAKE_INSTALL_LIBDIR@
includedir=${prefix}/@CMAKE_INSTALL_INCLUDEDIR@

Name: @NAME@
Description: Policy compiled by rlservo
Version: @VERSION@
Libs: -L${libdir} -l@NAME@
Libs.private: -lm
Cflags: -I${includedir}
"""
