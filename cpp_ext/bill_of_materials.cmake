# What is compiled into the extension and lies in the package beside it, with versions and licences, as a CycloneDX
# document in the wheel's metadata (PEP 770). Python packages that are only depended on are not in it.

# What the lines of a header that define numbers say, joined by dots.
function(rangesfm_version_in header names result)
  set(numbers)
  foreach(name IN LISTS names)
    file(STRINGS ${header} line REGEX "^#define ${name} +[0-9]+" LIMIT_COUNT 1)
    string(REGEX MATCH "[0-9]+$" number "${line}")
    list(APPEND numbers ${number})
  endforeach()
  string(REPLACE ";" "." version "${numbers}")
  set(${result} ${version} PARENT_SCOPE)
endfunction()

list(GET RANGESFM_CERES_INCLUDE_DIRS 0 ceres_headers)
rangesfm_version_in(${ceres_headers}/ceres/version.h
  "CERES_VERSION_MAJOR;CERES_VERSION_MINOR;CERES_VERSION_REVISION" CERES_HEADERS_VERSION)

get_target_property(eigen_headers Eigen3::Eigen INTERFACE_INCLUDE_DIRECTORIES)
list(GET eigen_headers 0 eigen_headers)
rangesfm_version_in(${eigen_headers}/Eigen/src/Core/util/Macros.h
  "EIGEN_WORLD_VERSION;EIGEN_MAJOR_VERSION;EIGEN_MINOR_VERSION" EIGEN_HEADERS_VERSION)

# What the first line of a bundled script says.
function(rangesfm_version_of_script file name result)
  file(READ ${CMAKE_CURRENT_SOURCE_DIR}/../plugin/rangesfm/report/assets/vendor/${file} text LIMIT 100)
  string(REGEX MATCH "${name} ([0-9.]+)" text "${text}")
  set(${result} ${CMAKE_MATCH_1} PARENT_SCOPE)
endfunction()

rangesfm_version_of_script(three.min.js "three\\.js" THREE_VERSION)
rangesfm_version_of_script(vega.min.js "Vega" VEGA_VERSION)
rangesfm_version_of_script(vega.min.js "Vega-Lite" VEGA_LITE_VERSION)

configure_file(bundled.cdx.json.in bundled.cdx.json @ONLY)
install(FILES ${CMAKE_CURRENT_BINARY_DIR}/bundled.cdx.json DESTINATION ${SKBUILD_METADATA_DIR}/sboms)
