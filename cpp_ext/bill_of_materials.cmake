# Bill of materials: the software that is compiled into the extension or shipped in the package, with versions and
# licences, as a CycloneDX document in the wheel's metadata (PEP 770). Python dependencies are not part of it.

# Ceres' version is given by three numbers in a header.
list(GET RANGESFM_CERES_INCLUDE_DIRS 0 ceres_headers)
foreach(name MAJOR MINOR REVISION)
  file(STRINGS ${ceres_headers}/ceres/version.h line REGEX "^#define CERES_VERSION_${name} +[0-9]+" LIMIT_COUNT 1)
  string(REGEX MATCH "[0-9]+$" number "${line}")
  list(APPEND CERES_HEADERS_VERSION ${number})
endforeach()
list(JOIN CERES_HEADERS_VERSION "." CERES_HEADERS_VERSION)

# Read the version of a library from the first line of a bundled script.
function(rangesfm_version_of_script file name result)
  file(READ ${CMAKE_CURRENT_SOURCE_DIR}/../plugin/rangesfm/report/assets/vendor/${file} text LIMIT 100)
  string(REGEX MATCH "${name} ([0-9.]+)" text "${text}")
  set(${result} ${CMAKE_MATCH_1} PARENT_SCOPE)
endfunction()

rangesfm_version_of_script(three.min.js "three\\.js" THREE_VERSION)
rangesfm_version_of_script(vega.min.js "Vega" VEGA_VERSION)
rangesfm_version_of_script(vega.min.js "Vega-Lite" VEGA_LITE_VERSION)

# Append a component to COMPONENTS and COMPONENT_NAMES; `purl` is the type of its package URL.
function(rangesfm_component name version license purl description)
  string(APPEND COMPONENTS "\n    { \"type\": \"library\", \"bom-ref\": \"${name}\", \"name\": \"${name}\", "
    "\"version\": \"${version}\", \"description\": \"${description}\", "
    "\"licenses\": [{ \"license\": { \"id\": \"${license}\" } }], \"purl\": \"pkg:${purl}/${name}@${version}\" },")
  set(COMPONENTS "${COMPONENTS}" PARENT_SCOPE)
  set(COMPONENT_NAMES "${COMPONENT_NAMES}\"${name}\", " PARENT_SCOPE)
endfunction()

rangesfm_component(eigen "${Eigen3_VERSION}" MPL-2.0 generic "headers, compiled into the extension")
rangesfm_component(ceres-solver "${CERES_HEADERS_VERSION}" BSD-3-Clause generic
  "headers of its cost functions and manifolds, compiled into the extension")
rangesfm_component(pybind11 "${pybind11_VERSION}" BSD-3-Clause pypi "headers, compiled into the extension")
rangesfm_component(three "${THREE_VERSION}" MIT npm "part of the report's page")
rangesfm_component(vega "${VEGA_VERSION}" BSD-3-Clause npm "part of the report's page, with parts of d3 (ISC)")
rangesfm_component(vega-lite "${VEGA_LITE_VERSION}" BSD-3-Clause npm "part of the report's page")
string(REGEX REPLACE ",$" "\n  " COMPONENTS "${COMPONENTS}")
string(REGEX REPLACE ", $" "" COMPONENT_NAMES "${COMPONENT_NAMES}")

configure_file(bundled.cdx.json.in bundled.cdx.json @ONLY)
install(FILES ${CMAKE_CURRENT_BINARY_DIR}/bundled.cdx.json DESTINATION ${SKBUILD_METADATA_DIR}/sboms)
