# Download the headers of Ceres and Eigen, for machines without packages of them, such as those that build the wheels.
#
# The result is the same as that of the packages: the target Eigen3::Eigen, Eigen3_VERSION and
# RANGESFM_CERES_INCLUDE_DIRS. Sources that are already on the disk can be used instead by setting
# FETCHCONTENT_SOURCE_DIR_CERES and FETCHCONTENT_SOURCE_DIR_EIGEN.

include(FetchContent)
if(POLICY CMP0135)
  cmake_policy(SET CMP0135 NEW) # extracted files get the time of the download
endif()

# Neither library is built, because neither has a CMakeLists.txt in a folder of this name.
FetchContent_Declare(ceres
  URL http://ceres-solver.org/ceres-solver-2.2.0.tar.gz
  URL_HASH SHA256=48b2302a7986ece172898477c3bcd6deb8fb5cf19b3327bc49969aad4cede82d
  SOURCE_SUBDIR headers_only)
set(Eigen3_VERSION 3.4.0)
FetchContent_Declare(eigen
  URL https://gitlab.com/libeigen/eigen/-/archive/${Eigen3_VERSION}/eigen-${Eigen3_VERSION}.tar.gz
  URL_HASH SHA256=8586084f71f9bde545ee7fa6d00288b264a2b7ac3607b974e54d13e7162c1c72
  SOURCE_SUBDIR headers_only)
FetchContent_MakeAvailable(ceres eigen)

# Include Ceres' configuration for builds without CMake, and its replacement for glog's header, too.
set(RANGESFM_CERES_INCLUDE_DIRS
  ${ceres_SOURCE_DIR}/include
  ${ceres_SOURCE_DIR}/config
  ${ceres_SOURCE_DIR}/internal/ceres/miniglog)

add_library(Eigen3::Eigen INTERFACE IMPORTED)
target_include_directories(Eigen3::Eigen SYSTEM INTERFACE ${eigen_SOURCE_DIR})
