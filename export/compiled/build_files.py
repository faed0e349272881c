"""Build files beside the C of a policy: CMake, and pkg-config through it."""

from __future__ import annotations

from collections.abc import Mapping


def build_files(prefix: str, version: str, weights_bytes: int | None) -> Mapping[str, str]:
    """Return the files by name. `weights_bytes` is the size of the file of weights, None without one."""
    found = {"CMakeLists.txt": CMAKE, f"{prefix}.pc.in": PKG_CONFIG}
    if weights_bytes is not None:
        found[f"{prefix}_weights.S"] = ASSEMBLY
        found["CMakeLists.txt"] = CMAKE.replace("LANGUAGES C)", "LANGUAGES C ASM)").replace(
            "add_library(@NAME@ @NAME@.c)", CMAKE_WEIGHTS
        )
    major = version if "." in version else f"{version}.0.0"
    return {name: text.replace("@NAME@", prefix).replace("@VERSION@", major) for name, text in found.items()}


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
CMAKE_WEIGHTS = """\
add_library(@NAME@ @NAME@.c @NAME@_weights.S)
set_source_files_properties(@NAME@_weights.S PROPERTIES
  COMPILE_OPTIONS -I${CMAKE_CURRENT_SOURCE_DIR} OBJECT_DEPENDS ${CMAKE_CURRENT_SOURCE_DIR}/@NAME@_weights.bin)"""
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
ASSEMBLY = """\
/* The weights of @NAME@.c as constants: compile this file beside it, with -I for the folder of @NAME@_weights.bin. */
#if defined(__BYTE_ORDER__) && __BYTE_ORDER__ != __ORDER_LITTLE_ENDIAN__
#error "the weights are little-endian"
#endif
#if defined(__APPLE__)
    .const
    .globl _@NAME@_weights
    .p2align 6
_@NAME@_weights:
#else
    .section .rodata
    .globl @NAME@_weights
    .balign 64
@NAME@_weights:
#endif
    .incbin "@NAME@_weights.bin"
#if defined(__linux__) && defined(__ELF__)
    .section .note.GNU-stack, "", %progbits
#endif
"""
